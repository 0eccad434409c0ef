"""What the network calls: the HTTP interface, and the web server around it."""
