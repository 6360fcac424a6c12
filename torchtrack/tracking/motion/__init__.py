"""The motion model of the Kalman filter, and what it predicts."""
