"""Pose graphs: a plan of factors, and two backends that solve the same plan."""
