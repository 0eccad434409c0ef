"""What Gaussian splats gain from refined poses: a judge that knows no LiDAR plane and none of our scores.

    python benchmarks/splats.py pack RECORDING RESULT --out FILE.npz [--camera recording] [--points N]
    python benchmarks/splats.py train FILE.npz --out FILE.json [--poses input result reference] [--steps N] [--seed N]

`pack` exports RESULT as a COLMAP model (`lvba export colmap`), and keeps its images and camera, and for each set of
poses (input, result, and RECORDING/reference where it is there) the cameras and points of the scans to start from.
`train` needs a CUDA device, PyTorch and gsplat (3D Gaussian Splatting, Kerbl et al. 2023; as Markov chain Monte Carlo,
Kheradmand et al. 2024), not lvba. It trains on seven of eight images and prints PSNR and SSIM over the pixels of the
eighth ones, which training never saw. All sets have the same images, camera, exposures, number of splats and seed:
only poses differ. The camera is the result's, or with `--camera recording` that of the recording, for poses that were
found with it. A set's own poses place these images, too, as is usual for splats.
"""

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

EVERY = 8
"""One image of so many is left out of training, as in the 3DGS paper."""
SETS = ("input", "result", "reference")
_JPEG_QUALITY = 97
_SH_DEGREE, _STEPS_PER_DEGREE = 2, 1000
_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5


def pack(recording: Path, result: Path, out: Path, camera: str, most: int) -> None:
    """Writes one file with everything that `train` needs."""
    from lvba.io.dataset import open_dataset
    from lvba.io.exposures import read_exposures
    from lvba.products.export import export

    with tempfile.TemporaryDirectory() as folder:
        left_out = "calibration.yaml" if camera == "recording" else ""
        for file in result.iterdir():
            if file.name != left_out:
                (Path(folder) / file.name).symlink_to(file.resolve())
        model = export(folder, "colmap", out.with_suffix(""))
    dataset = open_dataset(recording)
    words = (model / "sparse" / "0" / "cameras.txt").read_text().split("\n")[1].split()
    names = [Path(path).stem + ".png" for path in dataset.image_paths]
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    coded = [cv2.imencode(".jpg", cv2.imread(str(model / "images" / name)), quality)[1] for name in names]
    packed = {
        # width height fx fy cx cy; the first pixel's center is (0.5, 0.5)
        "camera": np.array(words[2:], float),
        "size": np.array([len(code) for code in coded]),
        "images": np.concatenate(coded),
        "exposure": read_exposures(result / "exposures.csv").relative,
    }
    folders = dict(zip(SETS, (recording, result, recording / "reference"), strict=True))
    for name in SETS:
        if (folders[name] / "image_poses.txt").exists() or name == "input":
            scans, images = _poses(dataset, folders[name])
            packed[f"{name}_cameras"] = images
            packed[f"{name}_points"] = _points(dataset, scans, most)
    np.savez_compressed(out, **packed)


def _poses(dataset: Any, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """world_from_scan (N, 4, 4) and world_from_camera (I, 4, 4) of a folder, or of the recording's input."""
    from neighbors import cameras

    from lvba.io.reference import read_reference
    from lvba.trajectory import nearest_in_time

    if folder.resolve() == Path(dataset.root).resolve():
        return dataset.scans.world_from_sensor, cameras(dataset, folder)
    scans = read_reference(folder).scans
    assert scans is not None, f"{folder} has no lidar_poses.txt"
    near = nearest_in_time(scans.times, dataset.scans.times)
    return scans.world_from_sensor[near], cameras(dataset, folder)


def _points(dataset: Any, world_from_scan: np.ndarray, most: int) -> np.ndarray:
    """(P, 3) float32 m: at most `most` points of the scans, evenly spread."""
    from lvba import geometry
    from lvba.io.dataset import load_scan
    from lvba.products.cloud import thin_to

    clouds = []
    for index, pose in enumerate(world_from_scan):
        points = load_scan(dataset, index).points.astype(float)
        clouds.append(geometry.transform_points(pose, points).astype(np.float32))
    cloud = np.concatenate(clouds)
    return cloud[thin_to(cloud, most)]


def train(file: Path, sets: list[str], out: Path, steps: int, splats: int, seed: int) -> None:
    """Trains one set of splats after the other; the figures so far are written after each."""
    packed = np.load(file)
    figures: dict[str, Any] = {}
    for name in sets:
        if f"{name}_cameras" in packed:
            figures[name] = _Trainer(packed, name, splats, seed).run(steps)
            print(file.stem, name, json.dumps(figures[name]), flush=True)
            out.write_text(json.dumps(figures, indent=1))


class _Trainer:
    """Splats of one set of poses."""

    def __init__(self, packed: Any, name: str, splats: int, seed: int) -> None:
        import torch
        from gsplat import MCMCStrategy

        self.torch = torch
        torch.manual_seed(seed)
        self.random = np.random.default_rng(seed)
        width, height, fx, fy, cx, cy = packed["camera"]
        self.width, self.height = int(width), int(height)
        self.matrix = self._on_device([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])[None]
        codes = np.split(packed["images"], np.cumsum(packed["size"])[:-1])
        rgb = np.stack(
            [cv2.cvtColor(cv2.imdecode(code, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB) for code in codes]
        )
        self.images = torch.from_numpy(rgb).cuda()
        self.exposure = self._on_device(packed["exposure"] / np.median(packed["exposure"]))
        poses = packed[f"{name}_cameras"]
        self.camera_from_world = self._on_device(np.linalg.inv(poses))
        self.scale = float(np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0), axis=1).max()) * 1.1
        self.parameters, self.optimizers = self._start(packed[f"{name}_points"])
        self.strategy = MCMCStrategy(cap_max=splats)
        self.strategy.check_sanity(self.parameters, self.optimizers)
        self.state = self.strategy.initialize_state()
        self.window = self._window()

    def _on_device(self, values: Any) -> Any:
        return self.torch.tensor(np.asarray(values, np.float32), device="cuda")

    def _start(self, points: np.ndarray) -> tuple[Any, Any]:
        """Parameters, and an optimizer for each: the rates of the 3DGS paper."""
        from scipy.spatial import cKDTree

        torch, count = self.torch, len(points)
        apart = cKDTree(points).query(points, k=4)[0][:, 1:].mean(1).clip(1e-4)
        start = {
            "means": (points, 1.6e-4 * self.scale),
            "scales": (np.log(apart)[:, None].repeat(3, 1), 5e-3),
            "quats": (self.random.normal(size=(count, 4)), 1e-3),
            "opacities": (np.zeros(count), 5e-2),  # half opaque
            "sh0": (np.zeros((count, 1, 3)), 2.5e-3),
            "shN": (np.zeros((count, (_SH_DEGREE + 1) ** 2 - 1, 3)), 2.5e-3 / 20),
        }
        parameters = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(self._on_device(values)) for name, (values, _) in start.items()}
        )
        optimizers = {
            name: torch.optim.Adam([{"params": parameters[name], "lr": rate, "name": name}], eps=1e-15)
            for name, (_, rate) in start.items()
        }
        return parameters, optimizers

    def _window(self) -> Any:
        torch = self.torch
        offset = torch.arange(_SSIM_WINDOW, device="cuda").float() - _SSIM_WINDOW // 2
        line = torch.exp(-(offset**2) / (2 * _SSIM_SIGMA**2))
        line = line / line.sum()
        return (line[:, None] * line[None])[None, None].expand(3, 1, -1, -1).contiguous()

    def _blurred(self, picture: Any) -> Any:
        return self.torch.nn.functional.conv2d(picture, self.window, groups=3)

    def _ssim(self, one: Any, other: Any) -> Any:
        """Mean over the image (Wang et al. 2004), pictures (H, W, 3) from 0 to 1."""
        a, b = one.permute(2, 0, 1)[None], other.permute(2, 0, 1)[None]
        mean_a, mean_b = self._blurred(a), self._blurred(b)
        var_a, var_b = self._blurred(a * a) - mean_a**2, self._blurred(b * b) - mean_b**2
        both = self._blurred(a * b) - mean_a * mean_b
        top = (2 * mean_a * mean_b + 1e-4) * (2 * both + 9e-4)
        return (top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean()

    def _render(self, index: int, degree: int) -> tuple[Any, Any]:
        from gsplat import rasterization

        p = self.parameters
        picture, _, information = rasterization(
            means=p["means"],
            quats=p["quats"],
            scales=self.torch.exp(p["scales"]),
            opacities=self.torch.sigmoid(p["opacities"]),
            colors=self.torch.cat([p["sh0"], p["shN"]], 1),
            viewmats=self.camera_from_world[index : index + 1],
            Ks=self.matrix,
            width=self.width,
            height=self.height,
            sh_degree=degree,
            packed=False,
        )
        return picture[0] * self.exposure[index], information

    def _picture(self, index: int) -> Any:
        return self.images[index].float() / 255

    def run(self, steps: int) -> dict[str, Any]:
        """Figures after half of the steps and after all."""
        began, figures = time.time(), {}
        count = len(self.images)
        kept = [index for index in range(count) if index % EVERY]
        fall = 0.01 ** (1 / steps)
        for step in range(steps):
            self._step(kept[self.random.integers(len(kept))], step)
            group = self.optimizers["means"].param_groups[0]
            group["lr"] *= fall
            if step + 1 in (steps // 2, steps):
                figures[f"after_{step + 1}"] = self._judged(count)
        return figures | {"seconds": time.time() - began, "splats": len(self.parameters["means"])}

    def _step(self, index: int, step: int) -> None:
        picture, information = self._render(index, min(_SH_DEGREE, step // _STEPS_PER_DEGREE))
        seen, p = self._picture(index), self.parameters
        loss = 0.8 * (picture - seen).abs().mean() + 0.2 * (1 - self._ssim(picture, seen))
        loss = loss + 0.01 * self.torch.sigmoid(p["opacities"]).mean()
        loss = loss + 0.01 * self.torch.exp(p["scales"]).mean()
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        rate = self.optimizers["means"].param_groups[0]["lr"]
        self.strategy.step_post_backward(
            self.parameters, self.optimizers, self.state, step, information, lr=rate
        )

    def _judged(self, count: int) -> dict[str, float]:
        figures: dict[str, list[float]] = {"psnr": [], "ssim": [], "psnr_trained": []}
        with self.torch.no_grad():
            for index in range(count):
                picture = self._render(index, _SH_DEGREE)[0].clamp(0, 1)
                seen = self._picture(index)
                psnr = -10 * math.log10(float(((picture - seen) ** 2).mean()))
                if index % EVERY:
                    figures["psnr_trained"].append(psnr)
                else:
                    figures["psnr"].append(psnr)
                    figures["ssim"].append(float(self._ssim(picture, seen)))
        return {name: float(np.mean(values)) for name, values in figures.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    packing, training = commands.add_parser("pack"), commands.add_parser("train")
    packing.add_argument("recording", type=Path)
    packing.add_argument("result", type=Path)
    packing.add_argument("--out", type=Path, required=True)
    packing.add_argument(
        "--camera", choices=("result", "recording"), default="result", help="whose calibration"
    )
    packing.add_argument("--points", type=int, default=100_000, help="to start from, at most")
    training.add_argument("file", type=Path)
    training.add_argument("--out", type=Path, required=True)
    training.add_argument("--poses", nargs="+", default=list(SETS), choices=SETS)
    training.add_argument("--steps", type=int, default=7000)
    training.add_argument("--splats", type=int, default=300_000)
    training.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.command == "pack":
        pack(given.recording, given.result, given.out, given.camera, given.points)
    else:
        train(given.file, given.poses, given.out, given.steps, given.splats, given.seed)


if __name__ == "__main__":
    main()
