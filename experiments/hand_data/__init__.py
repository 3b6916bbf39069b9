"""Training of the network that tells a hand's data from those of what it holds and of its forearm."""
