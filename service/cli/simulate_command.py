"""`lvba simulate`: a recording with known truth."""

import argparse

from service.cli import simulate_bag
from service.cli.progress import Display


def simulate(arguments: argparse.Namespace, display: Display) -> None:
    """Write the dataset folder, or a bag."""
    from lvba.simulate import disturbances
    from lvba.simulate import simulate as make

    display.stage(f"simulate {arguments.scene}", 0, 1)
    if arguments.bag:
        simulate_bag.write(arguments, display)
        return
    make(
        arguments.scene,
        arguments.out,
        frames=arguments.frames,
        seed=arguments.seed,
        difficulty=arguments.difficulty,
        lidar=arguments.lidar,
        vignetting=arguments.vignetting,
        motion_blur=arguments.motion_blur,
        shot_noise=arguments.shot_noise,
        width=arguments.width,
        height=arguments.height,
        points_per_scan=arguments.points,
        scans=arguments.scans,
        length=arguments.length,
        closing=arguments.closing,
        image_poses=arguments.image_poses,
        lens=arguments.lens,
        imu=arguments.imu,
        disturb=disturbances.parse(arguments.disturb),
        progress=display.progress,
    )
