"""Inside of robot descriptions: the record of a robot, its units, and the file written back."""
