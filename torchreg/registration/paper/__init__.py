"""The algorithm of Chang and Zwicker 2009 as printed, beside what registration does by default."""
