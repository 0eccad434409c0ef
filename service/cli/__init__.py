"""What people call: the commands of `lvba`."""
