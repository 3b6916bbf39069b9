"""Every table and figure of the three papers, made again: ``python -m experiments papers -o FOLDER``."""
