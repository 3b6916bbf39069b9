"""nn.Modules over (prediction, target); never hold a model."""
