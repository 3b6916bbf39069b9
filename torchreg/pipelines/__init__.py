"""The loops: one file, one task, one public function."""
