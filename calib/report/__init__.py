"""A page that a person can judge a calibration from."""
