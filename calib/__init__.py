"""What is known of a camera and its flash, with units, provenance and uncertainty."""
