"""The command line: one file per command, and the application that gathers them."""
