"""Who matches whom, and how much."""
