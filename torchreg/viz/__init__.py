"""Figures and conversions to other libraries, imported lazily."""
