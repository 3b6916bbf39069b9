"""Inside of glTF files: the document, its primitives, skins, clips and morph targets, read and written."""
