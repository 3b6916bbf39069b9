"""nn.Modules: parameters, buffers and forward() to geometry; no loss, no optimizer, no loop."""
