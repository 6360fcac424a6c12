"""Writers of events, one file per format."""
