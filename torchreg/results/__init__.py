"""What pipelines return: frozen records of tensors."""
