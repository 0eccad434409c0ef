"""Long recordings: solved in overlapping parts, merged, and finished as one problem whose sums are shared among tasks."""
