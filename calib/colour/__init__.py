"""From camera RGB to known colours, with a chart in the light of the room and of the flash."""
