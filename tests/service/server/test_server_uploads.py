"""Uploads: cut anywhere, sent twice, lied about; and archives of people who mean no good."""

import base64
import fcntl
import hashlib
import io
import random
import socket
import stat
import tarfile
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import pytest
from real_server import until

from lvba.errors import InputError
from service.datasets import archives, file_names
from service.datasets.intake_budget import IntakeBudget
from service.settings import Limits

PATH = "all_image/1.5.png"


def new_dataset(service, name="upload"):
    return service.http.post("/v1/datasets", json={"name": name}).json()["id"]


def digest(data):
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def put(service, dataset, data, path=f"files/{PATH}", **headers):
    return service.http.put(
        f"/v1/datasets/{dataset}/{path}",
        content=data,
        headers={name.replace("_", "-"): str(value) for name, value in headers.items()},
    )


def put_and_cut(service, dataset, data, offset, cut, path=PATH):
    """Begin to send the rest of a file, and go away after some bytes of it."""
    host, port = service.url.removeprefix("http://").split(":")
    head = (
        f"PUT /v1/datasets/{dataset}/files/{path} HTTP/1.1\r\nHost: {host}:{port}\r\n"
        f"Content-Length: {len(data) - offset}\r\nUpload-Offset: {offset}\r\nUpload-Length: {len(data)}\r\n\r\n"
    )
    with socket.create_connection((host, int(port))) as line:
        line.sendall(head.encode() + data[offset : offset + cut])


def arrived(service, dataset):
    answer = service.http.head(f"/v1/datasets/{dataset}/files/{PATH}")
    return 0 if answer.status_code == 404 else int(answer.headers["Upload-Offset"])


def test_upload_cut_a_hundred_times_ends_with_the_right_digest(service):
    rng = random.Random(1)
    data = rng.randbytes(3_000_000)
    dataset, cuts = new_dataset(service), 0
    while (offset := arrived(service, dataset)) < len(data) and cuts < 100:
        put_and_cut(service, dataset, data, offset, rng.randint(0, 50_000))
        cuts += 1
    assert cuts == 100
    for _ in range(100):
        offset = arrived(service, dataset)
        answer = put(
            service,
            dataset,
            data[offset:],
            Upload_Offset=offset,
            Upload_Length=len(data),
            Repr_Digest=digest(data),
        )
        if answer.status_code not in (409, 423):  # what was cut last may still be on its way
            break
    assert answer.status_code == 201, answer.text
    assert answer.json()["sha256"] == hashlib.sha256(data).hexdigest()
    head = service.http.head(f"/v1/datasets/{dataset}/files/{PATH}")
    assert head.headers["Upload-Complete"] == "?1"
    assert head.headers["Upload-Digest"] == hashlib.sha256(data).hexdigest()


def test_bytes_that_begin_elsewhere_than_at_the_end_are_refused(service):
    dataset = new_dataset(service)
    assert put(service, dataset, b"abc", Upload_Length=6).status_code == 200
    wrong = put(service, dataset, b"ef", Upload_Offset=4, Upload_Length=6)
    assert wrong.status_code == 409
    assert (wrong.json()["code"], wrong.headers["Upload-Offset"]) == ("offset-mismatch", "3")
    right = put(service, dataset, b"def", Upload_Offset=3, Upload_Length=6)
    assert (right.status_code, right.json()["sha256"]) == (201, hashlib.sha256(b"abcdef").hexdigest())


def test_digests_that_do_not_fit_begin_the_piece_or_the_file_anew(service):
    dataset = new_dataset(service)
    piece = put(service, dataset, b"abc", Upload_Length=6, Content_Digest=digest(b"abd"))
    assert (piece.status_code, piece.json()["code"]) == (422, "digest-mismatch")
    assert arrived(service, dataset) == 0
    assert put(service, dataset, b"abc", Upload_Length=6, Content_Digest=digest(b"abc")).status_code == 200
    whole = put(service, dataset, b"dex", Upload_Offset=3, Upload_Length=6, Repr_Digest=digest(b"abcdef"))
    assert whole.status_code == 422
    assert arrived(service, dataset) == 0
    assert put(service, dataset, b"abcdef", Repr_Digest=digest(b"abcdef")).status_code == 201


def upload_files(service, dataset):
    """What lies on disk of the uploads of a dataset."""
    return sorted((service.data / "datasets" / dataset / "uploads").glob("*"))


def test_request_that_is_refused_as_locked_changes_nothing(service):
    dataset = new_dataset(service)
    assert put(service, dataset, b"abc", Upload_Length=6).status_code == 200
    [file] = upload_files(service, dataset)
    with file.open("ab") as held:  # as by another service on the same folder
        fcntl.flock(held, fcntl.LOCK_EX)
        for body, headers in ((b"", {}), (b"xy", {}), (b"def", {"Upload_Offset": 3, "Upload_Length": 6})):
            refused = put(service, dataset, body, **headers)
            assert (refused.status_code, refused.json()["code"]) == (423, "locked")
        head = service.http.head(f"/v1/datasets/{dataset}/files/{PATH}").headers
        assert [head[f"Upload-{name}"] for name in ("Offset", "Length", "Complete")] == ["3", "6", "?0"]
    right = put(service, dataset, b"def", Upload_Offset=3, Upload_Length=6)
    assert (right.status_code, right.json()["sha256"]) == (201, hashlib.sha256(b"abcdef").hexdigest())
    assert file.read_bytes() == b"abcdef"


def test_file_whose_digest_is_taken_does_not_change(service):
    dataset, data = new_dataset(service), b"a" * 1000
    with ThreadPoolExecutor(1) as threads, service.held("digest"):
        first = threads.submit(put, service, dataset, data)
        while arrived(service, dataset) < len(data):
            time.sleep(0.02)
        other = put(service, dataset, b"b" * 1000)
        assert (other.status_code, other.json()["code"]) == (423, "locked")
    assert (first.result().status_code, first.result().json()["sha256"]) == (
        201,
        hashlib.sha256(data).hexdigest(),
    )
    assert [file.read_bytes() for file in upload_files(service, dataset)] == [data]


def test_other_content_replaces_the_file_and_what_is_refused_leaves_none(service):
    dataset = new_dataset(service)
    assert put(service, dataset, b"abc").status_code == 201
    wrong = put(service, dataset, b"xyz", path="files/other", Upload_Offset=3, Upload_Length=6)
    assert (wrong.status_code, wrong.headers["Upload-Offset"]) == (409, "0")
    assert put(service, dataset, b"other", Upload_Length=9).json()["complete"] is False
    assert [file.read_bytes() for file in upload_files(service, dataset)] == [b"other"]
    assert put(service, dataset, b"", path="files/other", Upload_Length=10**14).status_code == 413
    assert len(upload_files(service, dataset)) == 1


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Upload_Offset": "-1"}, 422),
        ({"Upload_Offset": "x"}, 422),
        ({"Upload_Length": "1"}, 422),
        ({"Upload_Length": str(10**14)}, 413),
        ({"Repr_Digest": "md5=:AAAA:"}, 422),
        ({"Content_Digest": "sha-256=:AAAA:"}, 422),
    ],
)
def test_headers_that_cannot_be_meant_are_refused(service, headers, status):
    answer = put(service, new_dataset(service), b"abc", **headers)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"


def test_many_files_at_once(service):
    dataset = new_dataset(service)
    data = {f"all_image/{n}.png": random.Random(n).randbytes(20_000) for n in range(50)}
    answers = []
    threads = [
        threading.Thread(target=lambda p=p, d=d: answers.append(put(service, dataset, d, path=f"files/{p}")))
        for p, d in data.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status_code for answer in answers} == {201}
    listed = service.http.get(f"/v1/datasets/{dataset}/files", params={"limit": 500}).json()["items"]
    assert {row["path"]: row["sha256"] for row in listed} == {
        path: hashlib.sha256(content).hexdigest() for path, content in data.items()
    }


@pytest.mark.parametrize(
    "path",
    ["../x", "a/../../x", "/etc/passwd", "a//b", "a\\b", "a/\x01", "x" * 300, "a/.", " a", "~root/x", "C:/x"],
)
def test_names_that_lead_elsewhere_are_refused(path):
    with pytest.raises(InputError):
        file_names.checked(path)


def test_name_through_a_link_leads_nowhere(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "link").symlink_to(tmp_path)
    (tmp_path / "secret").write_text("x")
    with file_names.opened(tmp_path, "secret") as file:
        assert file.read() == b"x"
    for root, path in (("inside", "link/secret"), ("inside/link", "secret"), ("", "inside")):
        with pytest.raises(InputError):
            file_names.opened(tmp_path / root, path)


def test_archive_of_a_recording_becomes_ready(service, tiny_recording):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        archive.add(tiny_recording, arcname="some/where/street")
    dataset = new_dataset(service)
    assert put(service, dataset, packed.getvalue(), path="archive").status_code == 201
    assert service.http.post(f"/v1/datasets/{dataset}/finish").status_code == 202
    found = until(service.http, f"/v1/datasets/{dataset}", lambda row: row["state"] in ("ready", "invalid"))
    assert found["state"] == "ready", found
    assert (found["facts"]["scans"], found["facts"]["images"]) == (8, 8)
    assert put(service, dataset, b"late").status_code == 409
    assert service.http.delete(f"/v1/datasets/{dataset}").status_code == 204
    assert service.http.get(f"/v1/datasets/{dataset}").status_code == 404


def test_recording_that_is_none_is_invalid_with_cause_and_hint(service):
    dataset = new_dataset(service)
    put(service, dataset, b"no picture")
    assert put(service, dataset, b"half", path="files/half.bin", Upload_Length=9).status_code == 200
    incomplete = service.http.post(f"/v1/datasets/{dataset}/finish")
    assert (incomplete.status_code, incomplete.json()["missing"]) == (409, ["half.bin"])
    service.http.delete(f"/v1/datasets/{dataset}/files/half.bin")
    service.http.post(f"/v1/datasets/{dataset}/finish")
    found = until(service.http, f"/v1/datasets/{dataset}", lambda row: row["state"] in ("ready", "invalid"))
    assert found["state"] == "invalid"
    assert found["error"]["code"] == "input"
    assert found["error"]["cause"].startswith("DATASET/")
    assert found["error"]["hint"]
    refused = service.http.post("/v1/jobs", json={"dataset": dataset})
    assert (refused.status_code, refused.json()["code"]) == (409, "not-ready")


def zipped(*entries):
    """A zip file of (name or ZipInfo, data)."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return packed.getvalue()


def tarred(*entries):
    """A tar file of (TarInfo, data)."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for info, data in entries:
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return packed.getvalue()


def tar_entry(name, kind=tarfile.REGTYPE, target=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def zip_link(name, target):
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info, target


def nul_name():
    return zipped(("a_b.txt", b"x")).replace(b"a_b.txt", b"a\0b.txt")


def lying_size():
    """A zip whose directory says that a file is small, and whose data is not."""
    data = bytearray(zipped(("big", bytes(50_000_000))))
    for mark, place in ((b"PK\x01\x02", 24), (b"PK\x03\x04", 22)):
        start = data.find(mark)
        data[start + place : start + place + 4] = (10).to_bytes(4, "little")
    return bytes(data)


HOSTILE = {
    "zip, up": lambda: zipped(("../evil", b"x")),
    "zip, absolute": lambda: zipped(("/tmp/evil", b"x")),
    "zip, backslash": lambda: zipped(("a\\..\\..\\evil", b"x")),
    "zip, link": lambda: zipped(zip_link("link", "/etc"), ("link/evil", b"x")),
    "zip, twice": lambda: zipped(("a", b"x"), ("A", b"y")),
    "zip, NUL": nul_name,
    "zip, file and folder": lambda: zipped(("a", b"x"), ("a/b", b"y")),
    "zip, bomb": lambda: zipped(("bomb", bytes(100_000_000))),
    "zip, lying size": lying_size,
    "zip, too many": lambda: zipped(*((f"f{n}", b"") for n in range(200))),
    "zip, broken": lambda: zipped(("a", b"x" * 1000))[:-30],
    "tar, up": lambda: tarred((tar_entry("../evil"), b"x")),
    "tar, absolute": lambda: tarred((tar_entry("/tmp/evil"), b"x")),
    "tar, link": lambda: tarred((tar_entry("link", tarfile.SYMTYPE, "/etc"), b"")),
    "tar, hard link": lambda: tarred((tar_entry("link", tarfile.LNKTYPE, "/etc/passwd"), b"")),
    "tar, device": lambda: tarred((tar_entry("null", tarfile.CHRTYPE), b"")),
    "tar, pipe": lambda: tarred((tar_entry("pipe", tarfile.FIFOTYPE), b"")),
    "tar, cut": lambda: tarred((tar_entry("a"), b"x" * 5000))[:2000],
    "no archive": lambda: b"\x00\x01 nothing" * 100,
    "pickle": lambda: (
        b"\x80\x04\x95\x1d\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x94\x8c\x06system\x94\x93\x94."
    ),
    "nothing": lambda: b"",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_archive_is_refused_and_nothing_is_written_outside(kind, tmp_path):
    archive, folder = tmp_path / "archive", tmp_path / "deep" / "folder"
    archive.write_bytes(HOSTILE[kind]())
    folder.mkdir(parents=True)
    limits = Limits(archive_entries=100, archive_bytes=80_000_000)
    with pytest.raises(InputError):
        archives.unpack(archive, folder, IntakeBudget(folder, limits))
    assert {path.name for path in tmp_path.rglob("*") if not path.is_relative_to(folder)} == {
        "archive",
        "deep",
    }
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 81_000_000
    assert not any(path.is_symlink() for path in folder.rglob("*"))


def test_hostile_archive_makes_the_dataset_invalid(service):
    dataset = new_dataset(service)
    put(service, dataset, HOSTILE["zip, up"](), path="archive")
    service.http.post(f"/v1/datasets/{dataset}/finish")
    found = until(service.http, f"/v1/datasets/{dataset}", lambda row: row["state"] in ("ready", "invalid"))
    assert found["state"] == "invalid"
    assert "'../evil'" in found["error"]["cause"]
    assert not list(service.data.rglob("evil"))
