"""Scan registration: bones, weights and motions of an articulated thing without a template."""
