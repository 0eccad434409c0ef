"""Folders of RGB-D benchmarks and phones, as each program writes them: the wall and mark of `known_view`."""

import json

import cv2
import known_view as view
import numpy as np
from scipy.spatial.transform import Rotation

SIZE, FOCAL, CENTER = (64, 48), (60.0, 61.0), (31.0, 24.5)
SMALL, SMALL_FOCAL, SMALL_CENTER = (32, 24), (30.0, 30.5), ((31.0 + 0.5) / 2 - 0.5, (24.5 + 0.5) / 2 - 0.5)
FLIP = np.diag([1.0, -1, -1, 1])


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def tum_line(stamp, pose):
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return " ".join([stamp, *(f"{value:.9f}" for value in (*pose[:3, 3], *quaternion))]) + "\n"


def tum(path, counted=False, units=5000, factor=None):
    lists = {"rgb": "# time file\n", "depth": "", "groundtruth": "# ground truth\n"}
    for i, pose in enumerate(view.poses()):
        stamp = str(i) if counted else f"1305031453.{359684 + 33333 * i}"
        png(path / "rgb" / f"{i}.png", view.color_image(SIZE, FOCAL, CENTER, pose))
        png(path / "depth" / f"{i}.png", view.depth_image(SIZE, FOCAL, CENTER, pose, units))
        for name in ("rgb", "depth"):
            lists[name] += f"{stamp} {name}/{i}.png\n"
        lists["groundtruth"] += tum_line(stamp, pose)
    for name, text in lists.items():
        (path / f"{name}.txt").write_text(text)
    camera = {"cam_width": SIZE[0], "cam_height": SIZE[1], "cam_fx": FOCAL[0], "cam_fy": FOCAL[1]}
    camera |= {"cam_cx": CENTER[0], "cam_cy": CENTER[1]}
    (path / "camera.yaml").write_text(json.dumps({"cam_model": camera, **(factor or {})}))


def replica(path):
    lines = ""
    for i, pose in enumerate(view.poses()):
        png(path / "results" / f"frame{i:06}.jpg", view.color_image(SIZE, FOCAL, CENTER, pose))
        png(path / "results" / f"depth{i:06}.png", view.depth_image(SIZE, FOCAL, CENTER, pose, 6553.5))
        lines += " ".join(f"{value:.9f}" for value in pose.ravel()) + "\n"
    (path / "traj.txt").write_text(lines)
    camera = dict(w=SIZE[0], h=SIZE[1], fx=FOCAL[0], fy=FOCAL[1], cx=CENTER[0], cy=CENTER[1], scale=6553.5)
    (path / "cam_params.json").write_text(json.dumps({"camera": camera}))


def matrix_text(matrix):
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in matrix) + "\n"


def k_matrix(focal, center, side=3):
    matrix = np.eye(side)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = *focal, *center
    return matrix


def scannet(path):
    for folder in ("pose", "intrinsic"):
        (path / folder).mkdir(parents=True)
    for i, pose in enumerate(view.poses()):
        number = 9 + i  # 9, 10, ...: numbers, not names, are in order
        png(path / "color" / f"{number}.jpg", view.color_image(SIZE, FOCAL, CENTER, pose))
        png(path / "depth" / f"{number}.png", view.depth_image(SMALL, SMALL_FOCAL, SMALL_CENTER, pose, 1000))
        (path / "pose" / f"{number}.txt").write_text(matrix_text(pose))
    (path / "pose" / "13.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (path / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(k_matrix(FOCAL, CENTER, 4)))
    (path / "intrinsic" / "intrinsic_depth.txt").write_text(
        matrix_text(k_matrix(SMALL_FOCAL, SMALL_CENTER, 4))
    )
    (path / "intrinsic" / "extrinsic_color.txt").write_text(matrix_text(np.eye(4)))


def seven_scenes(path):
    path.mkdir(exist_ok=True)
    for i, pose in enumerate(view.poses()):
        name = f"frame-{9 + i:06}"  # numbers, not places in the list
        depth = view.depth_image(SMALL, SMALL_FOCAL, SMALL_CENTER, pose, 1000)
        depth[0, :2] = 65535, 0
        png(path / f"{name}.depth.png", depth)
        png(path / f"{name}.color.png", view.color_image(SIZE, FOCAL, CENTER, pose))
        (path / f"{name}.pose.txt").write_text(matrix_text(pose))
    (path / "frame-000013.pose.txt").write_text("-1.#IND -1.#IND -1.#IND -1.#IND\n" * 4)
    (path / "camera-intrinsics.txt").write_text(matrix_text(k_matrix(SMALL_FOCAL, SMALL_CENTER)))
    camera = {"cam_width": SIZE[0], "cam_height": SIZE[1], "cam_fx": FOCAL[0], "cam_fy": FOCAL[1]}
    camera |= {"cam_cx": CENTER[0], "cam_cy": CENTER[1]}
    extrinsic = {"Rcl": np.eye(3).ravel().tolist(), "Pcl": [0.0, 0.0, 0.0]}
    (path / "camera.yaml").write_text(json.dumps({"cam_model": camera, "extrin_calib": extrinsic}))


def bundle_fusion(path):
    seven_scenes(path)
    for name in ("camera.yaml", "camera-intrinsics.txt"):
        (path / name).unlink()
    numbers = {
        "ColorIntrinsic": k_matrix(FOCAL, CENTER, 4),
        "DepthIntrinsic": k_matrix(SMALL_FOCAL, SMALL_CENTER, 4),
        "DepthExtrinsic": np.eye(4),
    }
    lines = [f"m_calibration{name} = " + " ".join(map(str, value.ravel())) for name, value in numbers.items()]
    (path / "info.txt").write_text("\n".join(["m_versionNumber = 4", "m_depthShift = 1000", *lines, ""]))


def stray(path):
    path.mkdir(exist_ok=True)
    video = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, SIZE)
    odometry = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    for i, pose in enumerate(view.poses()):
        video.write(view.color_image(SIZE, FOCAL, CENTER, pose))
        png(path / "depth" / f"{i:06}.png", view.depth_image(SMALL, SMALL_FOCAL, SMALL_CENTER, pose, 1000))
        sure = np.full(SMALL[::-1], 2, np.uint8)
        sure[:, 0] = 0
        png(path / "confidence" / f"{i:06}.png", sure)
        odometry += (
            tum_line(f"{3600.5 + i / 60:.9f}, {i:06},", pose)
            .replace(",,", ",")
            .replace(" ", ", ")
            .replace(",,", ",")
        )
    video.release()
    (path / "odometry.csv").write_text(odometry)
    (path / "camera_matrix.csv").write_text(
        "\n".join(", ".join(str(value) for value in row) for row in k_matrix(FOCAL, CENTER)) + "\n"
    )
    (path / "imu.csv").write_text(
        "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n3600.51, 0, 0, -1, 0.1, 0.2, 0.3\n"
    )


def polycam(path):
    frames = path / "keyframes"
    (frames / "corrected_cameras").mkdir(parents=True)
    for i, pose in enumerate(view.poses()):
        focal = (FOCAL[0] + 0.01 * i, FOCAL[1] + 0.01 * i)
        small = tuple(value / 2 for value in focal)
        png(frames / f"corrected_images/{100 + i}.jpg", view.color_image(SIZE, focal, CENTER, pose))
        png(frames / f"depth/{100 + i}.png", view.depth_image(SMALL, small, SMALL_CENTER, pose, 1000))
        arkit = pose @ FLIP
        keys = {f"t_{r}{c}": arkit[r, c] for r in range(3) for c in range(4)}
        keys |= dict(fx=focal[0], fy=focal[1], cx=CENTER[0], cy=CENTER[1], width=SIZE[0], height=SIZE[1])
        (frames / f"corrected_cameras/{100 + i}.json").write_text(json.dumps(keys))


def record3d(path):
    metadata = dict(w=SIZE[0], h=SIZE[1], dw=SMALL[0], dh=SMALL[1], fps=60, poses=[])
    metadata["K"] = k_matrix(FOCAL, CENTER).T.ravel().tolist()
    for i, pose in enumerate(view.poses()):
        png(path / f"rgbd/{i}.jpg", view.color_image(SIZE, FOCAL, CENTER, pose))
        small = (SMALL, tuple(value / 2 for value in FOCAL), SMALL_CENTER)
        meters = view.depth_image(*small, pose, 10_000).astype("<f4") / 10_000
        (path / f"rgbd/{i}.depth").write_bytes(meters.tobytes())
        (path / f"rgbd/{i}.conf").write_bytes(bytes([0] + [2] * (SMALL[0] * SMALL[1] - 1)))
        arkit = pose @ FLIP
        metadata["poses"].append([*Rotation.from_matrix(arkit[:3, :3]).as_quat(), *arkit[:3, 3]])
    (path / "metadata").write_text(json.dumps(metadata))
