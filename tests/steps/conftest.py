import pytest
import textured_recording
from textured_room import COUNT


@pytest.fixture(scope="module")
def room():
    return textured_recording.room()


@pytest.fixture
def recording_of_room(room, monkeypatch):
    """Makes the recording with some scan poses, and images of some numbers."""
    return lambda poses, images=range(COUNT): textured_recording.recording(room, poses, monkeypatch, images)
