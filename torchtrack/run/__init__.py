"""From a source through the tracker to files."""
