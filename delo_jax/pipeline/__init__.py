"""Streaming odometry over the scans of one sensor, and the trajectory it leaves."""
