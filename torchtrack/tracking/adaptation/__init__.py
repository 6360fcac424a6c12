"""What is learned while tracking."""
