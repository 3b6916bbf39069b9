"""The report of a sweep: one page with its question, tables, charts, failures and pictures."""
