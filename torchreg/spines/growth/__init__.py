"""Spines of things that grow: organs that appear and end."""
