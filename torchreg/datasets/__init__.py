"""Made-up but physically sensible data."""
