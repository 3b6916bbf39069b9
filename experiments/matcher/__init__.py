"""Training of the matcher of range scans: pairs of made-up creatures, a network, a curve."""
