"""Formulas without layers: neighbours, transport, consistency, evidence."""
