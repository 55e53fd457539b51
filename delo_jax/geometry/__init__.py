"""Rigid geometry in closed form: poses, alignments, planes."""
