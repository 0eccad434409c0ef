"""Servers that lie: the command line writes below --out only, shows no control codes, and ends with one line."""

import hashlib
import http.server
import json
from urllib.parse import unquote, urlsplit

import pytest
from stub_servers import serve

from service.cli import client, dispatch, main
from service.datasets import file_names

JOB = "job_0"
CODES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e\r"


class Hostile(http.server.ThreadingHTTPServer):
    """Answers each path with what `answers` has for it: JSON, bytes, or a function that writes what it likes."""

    def __init__(self):
        self.answers, self.asked = {}, []
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"

    def has(self, *results, job=None, **more):
        """A job that is done, and made these results: (name, content) or dictionaries."""
        shown = {"id": JOB, "name": "yard", "state": "done", "progress": 1.0, "created": "2026", "stages": []}
        self.answers[f"/v1/jobs/{JOB}"] = {**shown, **(job or {}), **more}
        items = []
        for result in results:
            if isinstance(result, dict):
                items.append(result)
                continue
            name, content = result
            items.append({"name": name, "bytes": len(content), "etag": '"x"', "url": "http://evil.invalid/"})
            items[-1]["sha256"] = hashlib.sha256(content).hexdigest()
            self.answers[f"/v1/jobs/{JOB}/results/{name}"] = content
        self.answers[f"/v1/jobs/{JOB}/results"] = {"items": items, "next": None}


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        path = unquote(urlsplit(self.path).path)
        self.server.asked.append((path, self.headers.get("Authorization")))
        found = self.server.answers.get(path)
        if callable(found):
            found(self)
            return
        status = 404 if found is None else 200
        body = found if isinstance(found, bytes) else json.dumps({} if found is None else found).encode()
        self.answer(body, status)

    def do_POST(self):
        self.do_GET()

    def answer(self, body, status=200, **headers):
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *words):
        pass


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    (tmp_path / "config.yaml").write_text("mine")
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(client, "_WAIT_S", 0.001)
    monkeypatch.setattr(client, "_LONGEST", 1 << 20)
    server = Hostile()
    serve(server)
    yield server
    server.shutdown()
    server.server_close()
    assert (tmp_path / "config.yaml").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.yaml", "work"]


@pytest.fixture
def ask(hostile, capsys):
    """Runs a command against the hostile server: exit code, stdout, stderr; no control code is in them."""

    def run(*words):
        code = dispatch.main(main.parser().parse_args([*map(str, words), "--server", hostile.url]))
        out, err = capsys.readouterr()
        for letter in "\x1b\x07\x9b\u202e\r":
            assert letter not in out + err
        assert "Traceback" not in err
        return code, out, err

    return run


@pytest.mark.parametrize(
    "name",
    ["..", ".", "/etc", "../..", "a/b", "", ".git", "~", "-rf", "x\x00y", CODES, "x" * 300, "CON", "a\\b"],
)
def test_job_of_any_name_is_fetched_into_a_folder_here(hostile, ask, tmp_path, name):
    hostile.has(("config.yaml", b"theirs"), name=name)
    code, out, _ = ask("fetch", JOB)
    assert (code, out) == (0, f"{JOB}\n")
    assert (tmp_path / "work" / JOB / "config.yaml").read_bytes() == b"theirs"
    assert [path.name for path in (tmp_path / "work").iterdir()] == [JOB]


def test_plain_name_is_the_folder_unless_it_holds_other_things_or_is_a_link(hostile, ask, tmp_path):
    hostile.has(("config.yaml", b"theirs"), name="yard 1")
    assert ask("fetch", JOB)[0] == 0
    assert ask("fetch", JOB)[0] == 0  # again: it holds nothing else
    assert (tmp_path / "work" / "yard 1" / "config.yaml").read_bytes() == b"theirs"
    (tmp_path / "work" / "src").mkdir()
    (tmp_path / "work" / "src" / "main.py").write_text("mine")
    (tmp_path / "work" / "link").symlink_to(tmp_path)
    for name, said in (("src", "holds other things"), ("link", "is a symbolic link")):
        hostile.has(("config.yaml", b"theirs"), name=name)
        code, _, err = ask("fetch", JOB)
        assert (code, len(err.splitlines())) == (2, 1)
        assert said in err
    assert not (tmp_path / "work" / "src" / "config.yaml").exists()


@pytest.mark.parametrize(
    "name",
    [
        "../config.yaml",
        "/tmp/x",
        "a/../../config.yaml",
        "..",
        "",
        "a//b",
        ".bashrc",
        "a/.b",
        "a\x1bb",
        "a\\b",
    ],
)
def test_results_that_lead_elsewhere_are_refused_before_anything_is_written(hostile, ask, tmp_path, name):
    hostile.has(("map.ply", b"x"), (name, b"theirs"))
    code, _, err = ask("fetch", JOB, "--out", "out")
    assert (code, len(err.splitlines())) == (1, 1)
    assert "do not trust this server" in err
    assert list((tmp_path / "work").iterdir()) == []


def test_no_link_in_the_folder_is_followed(hostile, ask, tmp_path):
    out = tmp_path / "work" / "out"
    out.mkdir()
    (out / "frames").symlink_to(tmp_path)
    hostile.has(("frames/config.yaml", b"theirs"))
    code, _, err = ask("fetch", JOB, "--out", out)
    assert code == 2
    assert "is a symbolic link" in err
    (out / ".config.yaml.partial").symlink_to(tmp_path / "config.yaml")
    (out / "config.yaml").symlink_to(tmp_path / "config.yaml")
    hostile.has(("config.yaml", b"theirs"))
    assert ask("fetch", JOB, "--out", out)[0] == 0  # the links themselves are replaced
    assert not (out / "config.yaml").is_symlink()
    assert (out / "config.yaml").read_bytes() == b"theirs"


def test_key_goes_to_no_other_server(hostile, ask, monkeypatch, tmp_path):
    monkeypatch.setenv("LVBA_KEY", "lvba_secret")
    other = Hostile()
    serve(other)
    hostile.has({"name": "map.ply", "bytes": 1, "etag": "", "url": f"{other.url}/map.ply"})
    hostile.answers[f"/v1/jobs/{JOB}/results/map.ply"] = lambda to: to.answer(
        b"", 302, Location=other.url + "/x"
    )
    code, _, err = ask("fetch", JOB, "--out", "out")
    assert (code, len(err.splitlines())) == (1, 1)
    assert other.asked == []
    assert hostile.asked[0][1] == "Bearer lvba_secret"
    other.shutdown()
    other.server_close()


def longer(to):
    to.send_response(200)
    to.end_headers()
    to.wfile.write(b"x" * 100_000)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"other", "does not have the digest"),
        (b"x", "does not have the size"),
        (longer, "is longer than was announced"),
        (lambda to: to.answer(b"oops", 500), "answered 500"),
        (lambda to: to.answer(b"right", 200, Content_Encoding="gzip"), "no lvba server would"),
    ],
)
def test_file_that_is_not_what_was_announced_is_not_kept(hostile, ask, tmp_path, answer, said):
    hostile.has(("map.ply", b"right"))
    hostile.answers[f"/v1/jobs/{JOB}/results/map.ply"] = answer
    code, _, err = ask("fetch", JOB, "--out", "out")
    assert (code, len(err.splitlines())) == (1, 1), err
    assert said in err
    assert not (tmp_path / "work" / "out" / "map.ply").exists()


def cut(to):
    to.send_response(200)
    to.send_header("Content-Length", "1000")
    to.end_headers()
    to.wfile.write(b'{"id"')


MALFORMED = {
    "no JSON": b"<html>" + CODES.encode(),
    "empty": b"",
    "not UTF-8": b'{"id": "\xff\xfe"}',
    "deep": b"[" * 200_000,
    "a list": [],
    "a text": "x",
    "null": b"null",
    "no fields": {"x": 1},
    "wrong types": {"id": JOB, "state": "done", "name": {"a": 1}, "stages": 7},
    "wrong id": {"id": "../../x", "state": "done"},
    "unknown state": {"id": JOB, "state": CODES},
    "NaN": b'{"id": "job_0", "state": "done", "progress": NaN}',
    "endless number": b'{"id": "job_0", "state": "done", "progress": ' + b"9" * 10_000 + b"}",
    "huge number": {"id": JOB, "state": "running", "eta_s": 1e300},
    "wrong stages": {"id": JOB, "state": "done", "stages": ["x", None]},
    "huge": b'"' + b"x" * (2 << 20) + b'"',
    "cut off": cut,
    "problem without words": lambda to: to.answer(b"[]", 404),
    "problem with codes": lambda to: to.answer(json.dumps({"detail": CODES, "hint": CODES}).encode(), 404),
    "a redirection": lambda to: to.answer(b"", 301, Location="http://127.0.0.1:9/"),
    "no HTTP": lambda to: to.wfile.write(CODES.encode() + b"\r\n\r\n"),
    "bad gzip": lambda to: to.answer(b"x", 200, Content_Encoding="gzip"),
}


@pytest.mark.parametrize("kind", MALFORMED)
def test_malformed_answers_are_one_line_of_every_command(hostile, ask, tmp_path, kind):
    pages = {"items": [MALFORMED[kind]]} if isinstance(MALFORMED[kind], dict) else MALFORMED[kind]
    for path in (f"/v1/jobs/{JOB}", f"/v1/jobs/{JOB}/cancel", f"/v1/jobs/{JOB}/logs"):
        hostile.answers[path] = MALFORMED[kind]
    for path in ("/v1/jobs", f"/v1/jobs/{JOB}/results", "/v1/datasets"):
        hostile.answers[path] = pages
    said = {"text": 1} if isinstance(MALFORMED[kind], dict) else MALFORMED[kind]
    hostile.answers[f"/v1/jobs/{JOB}/logs"] = said
    (tmp_path / "work" / "recording.zip").write_text("x")
    for words in (
        ("status", JOB), ("jobs",), ("logs", JOB), ("cancel", JOB), ("fetch", JOB), ("fetch", JOB, "--out", "out"),
        ("submit", "recording.zip"), ("submit", "ds_0", "--wait"), ("submit", "s3://a/b"),
    ):  # fmt: skip
        hostile.answers["/v1/datasets" if "s3" in words[-1] else "/v1/jobs"] = pages
        code, out, err = ask(*words)
        assert code in (1, 2), (words, out, err)
        last = [line for line in err.splitlines() if line.startswith("lvba: ")]
        assert len(last) == 1, (words, err)
        assert len(last[0]) < 2000


def test_what_a_server_says_is_shown_without_codes(hostile, ask):
    failure = {"cause": f"cause {CODES}", "hint": f"hint {CODES}"}
    stage = {"name": f"lidar{CODES}", "state": f"done{CODES}", "seconds": 1.5, "reused": True}
    hostile.has(name=f"yard{CODES}", created=CODES, error=failure, stages=[stage], state="failed")
    hostile.answers["/v1/jobs"] = {"items": [hostile.answers[f"/v1/jobs/{JOB}"]], "next": None}
    hostile.answers[f"/v1/jobs/{JOB}/logs"] = {
        "text": f"line {CODES}\n\tnext\n", "next": 9, "size": 9, "ended": True
    }  # fmt: skip
    assert "yard\\x1b]0;owned" in ask("status", JOB)[1]
    assert "yard\\x1b" in ask("jobs")[1]
    assert "\n\tnext\n" in ask("logs", JOB)[1]
    assert json.loads(ask("status", JOB, "--json")[1])["name"] == f"yard{CODES}"


def test_list_without_an_end_ends(hostile, ask):
    job = {"id": JOB, "state": "done", "name": "x"}
    hostile.answers["/v1/jobs"] = {"items": [job], "next": "again"}
    code, _, err = ask("jobs")
    assert code == 1
    assert "a list has no end" in err


@pytest.mark.parametrize(
    "name", ["..", ".hidden", "a/b", "a\\b", " x", "a\x9bb", "\u202exe.ply", "nul.txt", "~"]
)
def test_server_takes_no_name_that_could_lead_elsewhere(service, ready_dataset, name):
    answer = service.http.post("/v1/datasets", json={"name": name})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid")
    job = {"dataset": ready_dataset, "name": name}
    assert service.http.post("/v1/jobs", json=job).status_code == 422
    batch = {"name": name, "jobs": [{"dataset": ready_dataset}]}
    assert service.http.post("/v1/batches", json=batch).status_code == 422
    assert file_names.is_plain(file_names.plain(name, "x"))


def test_ordinary_names_stay_as_they_are():
    for name in ("yard", "Hof 3 (neu)", "2026-11-23 10:15", "été", "街道", "a.b", "v1.0", "x" * 200):
        assert file_names.is_plain(name), name
