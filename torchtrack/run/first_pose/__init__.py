"""The first pose of an object in a recording: from points picked by hand, from a box, or from a rough pose; refined on the events."""
