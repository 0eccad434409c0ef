"""Events to listeners: all of them, in order, once, whoever is slow, late, or many."""

import asyncio
import json
import socket
import threading
from contextlib import asynccontextmanager

import pytest
import uvicorn
from told_events import add_job, tell

from service.api import web_server
from service.db.database import Database
from service.jobs import broadcast
from service.jobs.broadcast import Broadcaster
from service.settings import Settings


@pytest.fixture
def database(tmp_path):
    database = Database(f"sqlite:///{tmp_path / 'lvba.sqlite'}")
    database.migrate()
    yield database
    database.close()


@asynccontextmanager
async def running(database):
    broadcaster = Broadcaster(database)
    task = asyncio.create_task(broadcaster.run())
    try:
        yield broadcaster
    finally:
        broadcaster.close()
        await task


class Heard:
    """What one stream tells."""

    def __init__(self, stream):
        self._stream, self._events = stream, []

    async def open(self):
        assert await anext(self._stream) == b": lvba\n\n"
        return self

    async def next(self):
        """Id and kind of the next event."""
        while not self._events:
            for text in (await anext(self._stream)).decode().split("\n\n"):
                if text.startswith("id:"):
                    data = json.loads(text.partition("data: ")[2])
                    self._events.append((data["id"], data["what"]))
        return self._events.pop(0)

    async def rest(self):
        """Kinds of all events up to the end of the stream."""
        found = []
        try:
            while True:
                found.append((await self.next())[1])
        except StopAsyncIteration:
            return found

    async def close(self):
        await self._stream.aclose()


def test_every_listener_hears_what_is_its_own(database):
    async def check():
        mine, other = add_job(database, "x"), add_job(database, "y")
        async with running(database) as broadcaster:
            owners = [await Heard(broadcaster.stream(None, None, "x")).open() for _ in range(50)]
            one = await Heard(broadcaster.stream(0, mine, "x")).open()
            stranger = await Heard(broadcaster.stream(0, mine, "y")).open()
            assert broadcaster.listeners == 52
            tell(database, other, "state", "end")
            last = tell(database, mine, "state", "progress")
            for listener in (*owners, one):
                assert [await listener.next() for _ in range(2)] == [(last - 1, "state"), (last, "progress")]
            tell(database, mine, "end")
            assert await one.rest() == ["end"]
            for listener in owners:
                assert await listener.next() == (last + 1, "end")
            broadcaster.close()
            for listener in (*owners, stranger):
                assert await listener.rest() == []

    asyncio.run(check())


def test_who_begins_to_listen_while_keys_are_looked_at_goes_on_hearing(database, monkeypatch):
    looked_at, has_begun = threading.Event(), threading.Event()

    def slow_readers(_database, names):
        looked_at.set()
        assert has_begun.wait(30)
        return dict.fromkeys(names, "x")

    monkeypatch.setattr(broadcast.keys, "readers", slow_readers)

    async def check():
        job = add_job(database)
        async with running(database) as broadcaster:
            first = await Heard(broadcaster.stream(None, None, "x", "one")).open()
            assert await asyncio.to_thread(looked_at.wait, 30)
            second = await Heard(broadcaster.stream(None, None, "x", "two")).open()
            has_begun.set()
            last = tell(database, job, "state")
            for listener in (first, second):
                assert await listener.next() == (last, "state")
                await listener.close()

    asyncio.run(check())


def test_listener_from_the_beginning_hears_what_is_stored_and_what_comes(database, monkeypatch):
    monkeypatch.setattr(broadcast, "_PAGE", 7)

    async def check():
        job = add_job(database)
        last = tell(database, job, *["stage"] * 40)
        async with running(database) as broadcaster:
            early = await Heard(broadcaster.stream(0, None, "x")).open()
            late = await Heard(broadcaster.stream(last - 3, None, "x")).open()
            assert [(await early.next())[0] for _ in range(40)] == list(range(last - 39, last + 1))
            assert [(await late.next())[0] for _ in range(3)] == [last - 2, last - 1, last]
            tell(database, job, *["stage"] * 20)
            for listener in (early, late):
                assert [(await listener.next())[0] for _ in range(20)] == list(range(last + 1, last + 21))
                await listener.close()
            assert broadcaster.listeners == 0

    asyncio.run(check())


def test_slow_listener_finds_in_the_journal_what_is_not_in_memory_any_more(database, monkeypatch):
    monkeypatch.setattr(broadcast, "_PAGE", 5)
    monkeypatch.setattr(broadcast, "_KEPT", 20)
    monkeypatch.setattr(broadcast, "_LOOK_S", 0.02)

    async def check():
        job = add_job(database)
        async with running(database) as broadcaster:
            slow = await Heard(broadcaster.stream(0, None, "x")).open()
            of_job = await Heard(broadcaster.stream(0, job, "x")).open()
            fast = await Heard(broadcaster.stream(0, None, "x")).open()
            for _ in range(10):
                last = tell(database, job, *["stage"] * 10)
                for _ in range(10):
                    await fast.next()
            for listener in (slow, of_job):
                assert [(await listener.next())[0] for _ in range(100)] == list(range(last - 99, last + 1))
                await listener.close()
            await fast.close()

    asyncio.run(check())


def test_progress_of_an_ended_job_is_not_told_to_who_comes_late(database):
    async def check():
        job, other = add_job(database), add_job(database)
        async with running(database) as broadcaster:
            first = await Heard(broadcaster.stream(0, None, "x")).open()
            tell(database, job, "progress", "stage", "log")
            tell(database, other, "progress")
            for _ in range(4):
                await first.next()
            tell(database, job, "end", "state", "progress")
            for _ in range(3):
                await first.next()
            second = await Heard(broadcaster.stream(0, None, "x")).open()
            told = [(await second.next())[1] for _ in range(5)]
            assert told == ["stage", "progress", "end", "state", "progress"]
            await first.close()
            await second.close()

    asyncio.run(check())


def test_stream_of_a_job_that_was_begun_again_goes_on(database):
    async def check():
        job = add_job(database)
        tell(database, job, "state", "end")
        async with running(database) as broadcaster:
            assert await Heard(broadcaster.stream(0, job, "x")).rest() == ["state", "end"]
            tell(database, job, "state")
            again = await Heard(broadcaster.stream(0, job, "x")).open()
            assert [(await again.next())[1] for _ in range(3)] == ["state", "end", "state"]
            tell(database, job, "end")
            assert await again.rest() == ["end"]

    asyncio.run(check())


def test_who_hears_nothing_for_long_is_told_that_the_stream_lives(database, monkeypatch):
    monkeypatch.setattr(broadcast, "_COMMENT_S", 0.0)

    async def check():
        async with running(database) as broadcaster:
            stream = broadcaster.stream(None, None, "x")
            assert [await anext(stream) for _ in range(3)] == [b": lvba\n\n", b": \n\n", b": \n\n"]
            await stream.aclose()

    asyncio.run(check())


def test_database_that_is_away_for_a_moment_ends_no_stream(database, monkeypatch):
    async def check():
        job = add_job(database)
        async with running(database) as broadcaster:
            listener = await Heard(broadcaster.stream(None, None, "x")).open()
            asked = threading.Event()
            read = broadcaster._read

            def away(*words):
                asked.set()
                raise broadcast.SQLAlchemyError("away")

            monkeypatch.setattr(broadcaster, "_read", away)
            tell(database, job, "stage")
            await asyncio.to_thread(asked.wait)
            monkeypatch.setattr(broadcaster, "_read", read)
            assert (await listener.next())[1] == "stage"
            await listener.close()

    asyncio.run(check())


def test_stream_ends_though_its_service_ends_just_before_it_waits(database):
    async def check():
        async with running(database) as broadcaster:
            listener = await Heard(broadcaster.stream(None, None, "x")).open()

            class ClosedMeanwhile(asyncio.Event):
                def clear(self):
                    broadcaster.close()
                    super().clear()

            [known] = broadcaster._listeners
            known.wake = ClosedMeanwhile()
            assert await asyncio.wait_for(listener.rest(), 10) == []

    asyncio.run(check())


def test_answers_are_sent_at_once_not_when_the_client_has_acknowledged_their_heads():
    web = uvicorn.Server(uvicorn.Config(lambda: None, host="127.0.0.1", port=0))
    with web_server.listening(web, Settings()) as [listening]:
        listening.listen()
        with socket.create_connection(listening.getsockname()):
            accepted, _ = listening.accept()
            with accepted:
                assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
