"""What docs/results.md says about itself and before each table."""

HEAD = """# Results

*Reference.* Accuracy on simulated and real recordings.

Made by `benchmarks/results.py` from runs of the installed command with default settings; nothing here is typed by hand.
Lengths in millimeters and angles in degrees are root mean squares over all frames. How the figures are defined:
[evaluation.md](evaluation.md). Seconds are wall time on two cores that had some other work beside (and
the first rows compile, too); for what a run takes by itself see [benchmarks.md](benchmarks.md).

Rows are of the present version, or of an older one if the last column says in what that differs:

| table | difference from the present version |
|---|---|
| recordings in parts, loops; hard difficulty but for courtyards; streets, medium | none |
| real recordings, poses of any method, gates of recordings | dark images have fewer features, and features of images \
lay out no scans |
| one disturbance: typical ones of seed 832 in rooms but for gaps, jumps and drift | the same, and errors of ranges that \
a first look leaves open are looked at with all points instead of some |
| other scenes that are not disturbed, medium and hard difficulty | expected errors of cameras have only a part of what \
uncertain errors of ranges make of them (in rooms 1.4 mm instead of 1.9); the same poses |
| ablations, degenerate directions; one disturbance: all but those above and below | the same, and scans learn less from \
cameras: what all cameras are off together counted twice (courtyards: scans 0.03 to 0.07 mm further off; rooms, streets \
and cameras the same) |
| three people; gates of seeds 119 and 120 | expected rotations of straight paths come from positions alone |
| typical disturbances of seeds 821 in rooms and 823 in the courtyard | several versions back: the expected error \
leaves out the common scale of range errors; images take points of scans by time alone; renderings of slanted \
surfaces, here and in all tables below, are up to a pixel off (lower PSNR and SSIM), and map entropy counts stray \
points |
| Gaussian splats | the version of the row above |
| gates of seed 121, colors of the map, errors of scans | what cameras have in common beside the scans counts \
as an error of the scans; the calibration keeps its claimed certainty; no rate of the camera's clock; images far apart \
in time share one point per voxel; no cameras over moved scans |
| what all models cost, what the other models bring | rough motions that are wrong by more than a decimeter or a \
degree, large images, and errors of scans are treated otherwise |
| gates of other seeds | expected camera errors leave out what cancels between images; no motion during images from \
their rows; single failed cameras stay; leave-one-out counts pixels that show what lies behind a surface \
([evaluation.md](evaluation.md#which-figure-decides)), and is lower for it |
| the IMU | exposures come from grey values by color |
"""

NOTES = {
    "recordings": """## Real recordings

Before -> after. PSNR and SSIM over covered pixels by the paper's protocol (points may be judged by the image that
colored them) and leave-one-out (only points colored from other images judge a pixel). Map entropy: lower is better.
""",
    "foreign": """## Poses of any method

Input, result and reference of the recordings, each given to `lvba evaluate` as poses of another method, all with
exposures and camera of the result. Where a result predicts images better than the reference itself, their distance
is no longer a measure of the result.
""",
    "splats": """## Gaussian splats

What 3D Gaussian splats (gsplat, 300,000 of them, 5,000 steps) predict of every eighth image, which training never
saw, by `benchmarks/splats.py` on one H200. They know no LiDAR plane and none of the scores above. A row has the same
images, exposures, camera and seed: only poses differ. Other seeds change 0.1 to 0.3 dB. References: KinectFusion
(7-Scenes) and motion capture (TUM): the result predicts images better than either, also with the camera that
these were made with.
""",
    "simulated": """## Simulated scenes with known truth, {difficulty} difficulty

Rough -> refined. Scans after alignment; cameras in the frame of the aligned LiDAR map; exposures after one common
scale. After the root mean squares, "median, 95 %": half and 95 % of the frames are off by less than so many millimeters.
"expected" is the error that the reported covariance predicts, NEES the normalized estimation error squared (1:
consistent).
""",
    "parts": """## Recordings in parts

One street, undivided and in overlapping parts: against the undivided solution (largest difference of any scan, camera
and exposure, after the scans are aligned), against the truth, and walls across seams relative to those of one side
alone.
""",
    "loops": """## Loops

In five parts of 32 scans. Ends that miss each other by 1 m and 2 degrees in the rough poses, beside the same place with
easy drift; and lanes whose facades repeat, where a closing that is tempting would be false.
""",
    "gates": """## Gates

Every part against the state before it, all else equal ([evaluation.md](evaluation.md)): gain with its standard error,
positive is better; what the truth says of that part alone, used or not (scans and cameras mm / deg, exposures %); and
whether the gate was right. "open": there is no truth, or position and rotation disagree, or both change by less than
2 % or than the reference is certain to.
""",
    "ablations": """## Ablations

One option each on the same simulated scenes, against truth, and leave-one-out.
""",
    "disturbed": """## One disturbance at a time

What real sensors do, one at a time ([list](simulation.md#disturbances)), not told to the program. "median, 95 %": half
and 95 % of the frames are off by less than so many millimeters. "expected" is the error that the report predicts, and
the verdict what a user without a reference reads; "perhaps more": the report says that
errors may be larger than expected. Exposures are compared after the one power of the light that images leave open.
**Bold**: more than three times the expected error without these words (exposures: without a reason that names them),
but for a common scale of the LiDAR's ranges, which the expected error leaves out
([evaluation.md](evaluation.md#how-good-is-my-map)).
""",
    "models": """## What each model of sensors brings

Scenes disturbed by typical sizes of what a model is of, by runs with all models and without this one; last, all at
once. Without -> with: errors against the truth as above, the verdict, and processor seconds of the run. "nothing
disturbed": what all models cost, and do to, a clean scene: the least seconds of several runs of each kind, in turns.
""",
    "colors": """## Colors of the map

The map as users keep it, colored by the version before views were ranked by angle and hidden by surfaces, and by
this one (before -> after), at the same poses and exposures. Wrong: points on the sides of a thin cabinet that carry the
color of the floor it stands on, in percent of the colored ones: all, those up to 0.3 m above the floor, and those
within 5 cm of an upright or upper edge; and points of the floor within 0.3 m of it that carry the cabinet's. Error:
mean absolute difference from the true color, grey values (0..255), over all colored points. Range noise is 20 mm.
""",
    "imu": """## IMU

Without -> with `imu.csv` of `lvba simulate --imu` (`benchmarks/imu_factors.py`; images of 320 x 240, medium \
difficulty).
"open": scans that planes leave a direction of open without the IMU, how many, and their errors in both runs; tilt: how
far the direction of gravity is off in the frame of the true poses, and one standard deviation as reported.
""",
    "degenerate directions": """## Degenerate directions

Scenes that leave motions undetermined: what is reported, and the errors of input and result.
""",
}
