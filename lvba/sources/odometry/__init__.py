"""Poses for recordings that have none: scans registered one after another, and a gate that notices when that fails."""
