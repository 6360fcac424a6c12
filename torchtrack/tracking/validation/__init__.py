"""Whether a pose is right: measures, scores and statuses."""
