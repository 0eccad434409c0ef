"""Recordings of the service: uploads, archives, checks, names, quotas."""
