"""Inside of robot descriptions: XML, the record of a robot, its meshes and units, and the file written back."""
