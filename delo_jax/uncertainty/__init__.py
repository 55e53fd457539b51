"""From the network's numbers to a covariance and a health status: pure functions on the host."""
