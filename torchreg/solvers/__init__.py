"""Generic numerics that know nothing of hands or scans."""
