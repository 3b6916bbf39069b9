"""Where a robot's base is in a camera's coordinates, and how surely."""
