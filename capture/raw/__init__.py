"""Camera RAW and DNG: linear radiance out of a sensor's own numbers, and what the file says of them.

    picture = read_raw(path)         # capture.raw.reader
    picture.radiance                 # [H, W, 3] float32, camera RGB, 1.0 = white clip before any gain map
    picture.clipped                  # [H, W] bool

LibRaw (through rawpy) unpacks and demosaics; levels and DNG gain maps are ours, because LibRaw rounds black
levels, leaves gain maps out and would cut what they lift above white.
"""
