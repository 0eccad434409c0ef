"""Recordings before they are a recording folder: bags and folders of other programs, and what makes a folder of them."""
