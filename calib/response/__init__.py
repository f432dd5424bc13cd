"""From stored values to linear radiance, found in an exposure sweep."""
