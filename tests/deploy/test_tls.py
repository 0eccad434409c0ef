"""Certificates: what is made, what stays, what is made again, and who is let in with them."""

import shutil
import subprocess

import pytest
from deployed import DEPLOY
from programs import program_or_skip


def tls(folder, *names, code=0):
    done = subprocess.run(["sh", DEPLOY / "tls.sh", folder, *names], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return [line.rpartition("/")[2] for line in done.stderr.splitlines()]


def openssl(*words):
    done = subprocess.run([program_or_skip("openssl"), *map(str, words)], capture_output=True, text=True)
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    tls(folder, "lvba.example.org", "10.1.2.3", "fd00::7")
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "tls")


def test_only_the_owner_may_read_what_is_made(folder):
    assert tls(folder, "lvba.example.org") == []
    for path in folder.rglob("*"):
        assert path.stat().st_mode & 0o077 == 0, path
    assert sorted(path.name for path in (folder / "cluster").iterdir()) == ["ca.pem", "node.key", "node.pem"]
    assert sorted(path.name for path in (folder / "web").iterdir()) == ["ca.pem", "server.key", "server.pem"]


def test_certificates_are_good_for_what_they_are_for_and_nothing_else(folder):
    for authority, file, purpose, other in (
        ("cluster", "node", "sslclient", "web"),
        ("cluster", "node", "sslserver", "web"),
        ("web", "server", "sslserver", "cluster"),
    ):
        ca, pem = folder / authority / "ca.pem", folder / authority / f"{file}.pem"
        assert openssl("verify", "-x509_strict", "-purpose", purpose, "-CAfile", ca, pem).endswith(": OK\n")
        assert "verification failed" in openssl("verify", "-CAfile", folder / other / "ca.pem", pem)
    server = folder / "web" / "server.pem"
    refused = openssl("verify", "-purpose", "sslclient", "-CAfile", folder / "web" / "ca.pem", server)
    assert "verification failed" in refused
    names = openssl("x509", "-in", server, "-noout", "-ext", "subjectAltName")
    assert "DNS:lvba.example.org, IP Address:10.1.2.3, IP Address:FD00:0:0:0:0:0:0:7" in names


def test_what_is_good_stays_and_another_name_makes_a_new_certificate(folder):
    before = {path: path.read_bytes() for path in folder.rglob("*.*")}
    assert tls(folder, "lvba.example.org", "10.1.2.3") == []
    assert tls(folder, "lvba.example.org", "other.example.org") == ["server.pem"]
    changed = {path.name for path, content in before.items() if path.read_bytes() != content}
    assert changed == {"server.pem", "server.key"}


def test_what_ends_within_a_month_or_does_not_fit_its_key_is_made_again(folder):
    authority = folder / "authority" / "cluster"
    node = folder / "cluster" / "node"
    request = openssl("req", "-new", "-key", f"{node}.key", "-subj", "/CN=lvba cluster")
    (folder / "csr").write_text(request)
    openssl("x509", "-req", "-in", folder / "csr", "-days", 20, "-CA", f"{authority}.pem",
            "-CAkey", f"{authority}.key", "-set_serial", 7, "-out", f"{node}.pem")  # fmt: skip
    assert tls(folder, "lvba.example.org") == ["node.pem"]
    assert openssl("x509", "-in", f"{node}.pem", "-noout", "-checkend", 86400 * 300).startswith(
        "Certificate will not"
    )
    shutil.copy(f"{authority}.key", f"{node}.key")
    assert tls(folder, "lvba.example.org") == ["node.pem"]


def test_new_authority_means_new_certificates(folder):
    (folder / "authority" / "web.pem").unlink()
    assert tls(folder, "lvba.example.org") == ["web.pem", "server.pem"]
    ca, pem = folder / "web" / "ca.pem", folder / "web" / "server.pem"
    assert openssl("verify", "-CAfile", ca, pem).endswith(": OK\n")


def test_certificate_of_somebody_else_stays(folder):
    web = folder / "web"
    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", 9, "-subj", "/CN=mine",
            "-keyout", web / "server.key", "-out", web / "server.pem")  # fmt: skip
    content = (web / "server.pem").read_bytes()
    assert tls(folder, "another.example.org") == ["server.pem is somebody else's and stays"]
    assert (web / "server.pem").read_bytes() == content


def test_without_a_name_it_says_how_it_is_used(tmp_path):
    assert "usage" in tls(tmp_path / "tls", code=2)[0]
    assert not (tmp_path / "tls").exists()
