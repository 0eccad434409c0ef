"""Simulated sources with other records than they had."""

from dataclasses import replace

from lvba.simulate.raw import Sensors
from lvba.sources.source import ListSource

SMALL = Sensors(points=600, width=64, height=48, image_hz=5.0)
"""Of sources of which only what their records say matters."""


def changed(source, change):
    """The source with other records, in time order. change(name, record): a list of (name, record) in its place."""
    items = [item for name, record in source.items for item in change(name, record)]
    known = {each.name: each for each in source.description.streams}
    kinds = {type(record): known[name] for name, record in source.items}
    streams = []
    for name in dict.fromkeys(name for name, _ in items):
        records = [record for stream, record in items if stream == name]
        streams.append(replace(kinds[type(records[0])], name=name, count=len(records)))
    return ListSource(replace(source.description, streams=tuple(streams)), tuple(items), source.known)
