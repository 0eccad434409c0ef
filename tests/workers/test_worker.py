"""A worker that finds no scheduler."""

import asyncio

import dask
import pytest
from distributed.security import Security
from ports import free_port

from workers import worker


def life(address):
    async def live():
        stop = asyncio.create_task(asyncio.Event().wait())
        with dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}):
            await worker._one_life(address, Security(), 10**9, stop, lambda said: None)

    asyncio.run(live())


def test_nobody_at_the_address_for_longer_than_a_connection_waits_is_no_error():
    life(f"tcp://127.0.0.1:{free_port()}")


def test_what_is_no_trouble_with_connections_goes_through(monkeypatch):
    async def start(nanny):
        raise RuntimeError("failed to start") from ValueError("no such plugin")

    monkeypatch.setattr(worker.Nanny, "start", start)
    with pytest.raises(RuntimeError):
        life(f"tcp://127.0.0.1:{free_port()}")
