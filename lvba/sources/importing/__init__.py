"""From any `Source` to a recording folder, with the conventions found from the data, told, and kept as evidence."""
