"""The pipeline, a folder a stage, in the order of the data."""
