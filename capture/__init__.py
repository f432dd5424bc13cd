"""From devices, videos and image sets to a session folder: the one contract between capture and fit."""
