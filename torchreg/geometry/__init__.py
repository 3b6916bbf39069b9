"""Pure functions on tensors and frozen dataclasses; no nn.Module, no files."""
