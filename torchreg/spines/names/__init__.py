"""Names of tips over time: which tip of a frame is which tip of the body."""
