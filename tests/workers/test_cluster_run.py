"""`lvba run` on clusters and over stores elsewhere: real stages, real processes, and always the same bytes."""

from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer
from real_cluster import Cluster, tls_files
from split_street import artifacts, products

from workers import connection


@pytest.fixture(scope="module")
def tls(tmp_path_factory):
    return tls_files(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="module")
def tls_cluster(tls, tmp_path_factory):
    started = Cluster(tmp_path_factory.mktemp("tls_cluster"), tls)
    for _ in range(2):
        started.start_worker()
    yield started
    started.end()


def test_without_a_certificate_nobody_is_let_in(tls_cluster):
    scheduler = connection.at(tls_cluster.address.replace("tls", "tcp"), None)
    with pytest.raises(connection.ClusterError, match="no scheduler answers"):
        scheduler.connect(0.1, lambda: None)


def test_over_tls(undisturbed, recording, lvba, tls_cluster, tmp_path):
    lvba("run", recording, "--out", tmp_path, "--reference", recording / "reference", *tls_cluster.on())
    assert products(tmp_path) == products(undisturbed[0])
    assert artifacts(tmp_path / "stages") == artifacts(undisturbed[0] / "stages")


@pytest.fixture(scope="module")
def bucket():
    """An S3 server on this machine, with an empty bucket."""
    server = ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "any",
        "AWS_SECRET_ACCESS_KEY": "any",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        client = boto3.client("s3")
        client.create_bucket(Bucket="maps")
        yield client
    server.stop()


def download(bucket, prefix, folder):
    for page in bucket.get_paginator("list_objects_v2").paginate(Bucket="maps", Prefix=prefix):
        for item in page["Contents"]:
            path = folder / Path(item["Key"]).relative_to(prefix)
            path.parent.mkdir(parents=True, exist_ok=True)
            bucket.download_file("maps", item["Key"], str(path))
    return folder


def test_own_workers_and_a_store_in_a_bucket(undisturbed, recording, lvba, bucket, tmp_path):
    run = ["run", recording, "--out", tmp_path / "out", "--reference", recording / "reference"]
    lvba(*run, "--store", "s3://maps/street", "--workers", 2)
    assert products(tmp_path / "out") == products(undisturbed[0])
    assert not (tmp_path / "out" / "stages").exists()
    stored = artifacts(download(bucket, "street", tmp_path / "bucket"))
    assert stored == artifacts(undisturbed[0] / "stages")
