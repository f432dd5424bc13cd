"""Camera RAW and DNG: linear radiance out of a sensor's own numbers, and what the file says of them.

    picture = read_raw(path)         # capture.raw.reader
    picture.radiance                 # [H, W, 3] float32, camera RGB, 1.0 = white clip before any gain map
    picture.clipped                  # [H, W] bool

LibRaw (through rawpy) unpacks; levels, DNG gain maps and the demosaicing of Bayer mosaics are ours, because
LibRaw rounds black levels, leaves gain maps out and cuts at 16 bits.
"""
