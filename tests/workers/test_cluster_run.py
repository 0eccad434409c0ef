"""`lvba run` on a cluster: real stages, real processes, and the same bytes."""

import shutil

import pytest
from real_cluster import Cluster, tls_files
from split_street import artifacts, artifacts_in_bucket, products

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


def test_over_tls(tiny_recording, lvba, tls_cluster, tmp_path):
    run = ["run", tiny_recording, "--reference", tiny_recording / "reference", "--out"]
    alone, out = tmp_path / "alone", tmp_path / "out"
    lvba(*run, alone)
    lvba(*run, out, *tls_cluster.on())
    assert products(out) == products(alone)
    assert artifacts(out / "stages") == artifacts(alone / "stages") != {}


@pytest.fixture
def without_images(tiny_recording, tmp_path):
    """What becomes of images is many files, and each takes requests."""
    folder = tmp_path / "scans"
    shutil.copytree(tiny_recording / "all_pcd_body", folder / "all_pcd_body")
    shutil.copy(tiny_recording / "config.yaml", folder)
    return folder


def test_with_a_store_in_a_bucket(without_images, lvba, bucket, tmp_path):
    alone, out = tmp_path / "alone", tmp_path / "out"
    lvba("run", without_images, "--out", alone)
    lvba("run", without_images, "--out", out, "--store", "s3://maps/run", "--workers", 2)
    for name in ("lidar_poses.txt", "map.ply", "config.yaml"):
        assert (out / name).read_bytes() == (alone / name).read_bytes(), name
    assert not (out / "stages").exists()
    assert artifacts_in_bucket(bucket, "run") == artifacts(alone / "stages") != {}
