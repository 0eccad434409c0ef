"""The verdict: what figures make of a result, and that nothing dubious is called good."""

import math
from dataclasses import replace

import pytest

from lvba.dataset import InputFindings
from lvba.products import lengths
from lvba.steps import verdict, verdict_data
from lvba.steps.verdict_figures import Figures, Judged, Truth


def scaled(what, error, rough, predicted, after):
    """An error in position, and what is left after one common factor."""
    return Truth(what=what, unit="m", error=error, rough=rough, predicted=predicted, scaled=after)


USED, NOT_USED = Judged(True, "accepted"), Judged(False, "not sharper")
CLEAN = Figures(
    scans=100, images=100, scan_poses=USED, camera_poses=USED, exposures=USED, scans_with_cameras=USED,
    overdispersion=1.4, spline_error=0.4, fusion_variance_factor=1.0, extrinsic_sigmas=1.0,
)  # fmt: skip
KEPT = (Truth("scans", "m", 0.001, 0.07, 0.0009), Truth("cameras", "degrees", 0.01, 0.2, 0.02))


@pytest.mark.parametrize(
    ("change", "level", "at_least"),
    [
        ({}, "good", False),
        ({"images": 0, "camera_poses": Judged(), "exposures": Judged(), "overdispersion": None}, "good", False),
        ({"scan_poses": NOT_USED}, "check", False),
        ({"scan_poses": NOT_USED, "overdispersion": 9.0}, "check", True),
        ({"camera_poses": NOT_USED, "overdispersion": 9.0}, "check", True),
        ({"camera_poses": NOT_USED}, "check", False),
        ({"exposures": NOT_USED}, "check", False),
        ({"scans_with_cameras": NOT_USED}, "check", False),
        ({"scan_poses": NOT_USED, "camera_poses": NOT_USED}, "bad", False),
        ({"scan_poses": NOT_USED, "images": 0, "camera_poses": Judged()}, "bad", False),
        ({"camera_poses": Judged(False, "images confirm them", confirmed=True)}, "good", False),
        ({"overdispersion": 1.7}, "check", True),
        ({"overdispersion": 90.0, "camera_refined": True}, "check", False),
        ({"spline_error": 0.81}, "check", True),
        ({"fusion_variance_factor": 1.21}, "check", True),
        ({"overdispersion": 1.6, "spline_error": 0.8, "fusion_variance_factor": 1.2}, "good", False),
        ({"common_degenerate": 1}, "check", False),
        ({"common_degenerate": 1, "scans_with_cameras": Judged(True, "")}, "check", False),
        ({"common_degenerate": 1, "apart_from_cameras_m": 0.02, "scans_m": 0.01}, "check", False),
        ({"common_degenerate": 1, "apart_from_cameras_m": 0.04, "scans_m": 0.01}, "bad", True),
        ({"apart_from_cameras_m": 0.04, "scans_m": 0.01}, "good", False),
        ({"degenerate_scans": 6}, "check", False),
        ({"degenerate_scans": 5}, "good", False),
        ({"odometry_dependent_steps": 1}, "check", False),
        ({"uncertain_scans": 6}, "check", False),
        ({"uncertain_cameras": 6}, "check", False),
        ({"uncertain_cameras": 5}, "good", False),
        ({"uncertain_exposures": (36, 37)}, "check", False),
        ({"moved_m": 0.004}, "check", False),
        ({"moved_m": 0.004, "scan_p95_m": 0.005}, "check", False),
        ({"moved_m": 0.0002, "scan_p95_m": 0.005}, "good", False),
        ({"moved_m": 0.006, "scan_p95_m": 0.005}, "check", True),
        ({"moved_m": 0.07, "scan_p95_m": 0.1}, "bad", False),
        ({"moved_m": 0.04, "scan_p95_m": 0.05}, "check", False),
        ({"moved_m": 0.07, "scan_p95_m": 0.2}, "check", False),
        ({"moved_m": 0.06, "scan_p95_m": 2.0}, "good", False),
        ({"cameras_converged": False}, "check", False),
        ({"jumps": 1, "jump_m": 0.3}, "check", False),
        ({"jumps": 1, "jump_m": 1.0, "unconfirmed_jumps": (4,)}, "bad", True),
        ({"range_errors": 1}, "check", True),
        ({"input": InputFindings(skipped_scans=12)}, "check", False),
        ({"input": InputFindings(skipped_images=12)}, "check", False),
        ({"input": InputFindings(skipped_scans=11, skipped_images=11)}, "good", False),
        ({"input": InputFindings(apart_s=3600.0)}, "check", False),
        ({"input": InputFindings(repeated_scans=5, repeated_poses=5)}, "good", False),
        ({"input": InputFindings(repeated_scans=6)}, "check", True),
        ({"input": InputFindings(repeated_scans=99)}, "bad", True),
        ({"input": InputFindings(repeated_poses=99)}, "check", False),
        ({"input": InputFindings(speed_m_s=900.0)}, "check", True),
        ({"input": InputFindings(range_m=9000.0)}, "check", True),
        ({"input": InputFindings(poses_as="w_first")}, "check", True),
        ({"input": InputFindings(poses_as="inverse")}, "check", True),
        ({"input": InputFindings(poses_as="world")}, "bad", True),
        ({"registered": True, "rough_m": 0.3}, "check", False),
        ({"registered": True, "open_steps": 1}, "bad", True),
        ({"registered": True}, "check", False),
        ({"registered": True, "odometry_dependent_steps": 1}, "check", True),
        ({"registered": True, "left_steps": 1}, "bad", True),
        ({"registered": True, "left_steps": 1, "scan_poses": NOT_USED}, "bad", False),
        ({"extrinsic_sigmas": 3.1}, "check", False),
        ({"late_s": 0.3}, "check", False),
        ({"late_s": -0.07}, "check", False),
        ({"late_s": 0.04, "patches_per_image": 40.0}, "good", False),
        ({"patches_per_image": 6.1}, "check", True),
        ({"alike": 0.23}, "bad", True),
        ({"alike": 0.64}, "good", False),
        ({"open_pauses": (10,)}, "check", True),
        ({"ssim": (0.47, 0.35)}, "check", False),
        ({"thickness": (0.012, 0.013)}, "check", False),
        ({"scans": 9}, "check", False),
        ({"images": 9}, "check", False),
        ({"truth": KEPT}, "good", False),
        ({"truth": (Truth("scans", "m", 0.03, 0.09, 0.0095),)}, "check", True),
        ({"truth": (scaled("scans", 0.03, 0.09, 0.001, 0.002),), "scale": 0.998}, "check", False),
        ({"truth": (scaled("scans", 0.002, 0.09, 0.001, 0.001),), "scale": 0.998}, "good", False),
        ({"truth": (scaled("scans", 0.03, 0.09, 0.001, 0.004),), "scale": 0.998}, "check", True),
        ({"truth": (Truth("cameras", "degrees", 0.2, 0.18, 0.1),)}, "check", False),
        ({"truth": (Truth("cameras", "m", 0.04, 0.03, 0.05),)}, "check", False),
        ({"truth": (Truth("cameras", "m", 0.04, 0.03, 0.02),)}, "bad", False),
    ],
)  # fmt: skip
def test_figures_decide(change, level, at_least):
    found = verdict.judge(replace(CLEAN, **change))
    assert (found.level, found.at_least) == (level, at_least)
    assert bool(found.reasons) == (level != "good")
    for reason in found.reasons:
        assert reason.text.endswith(".")
        assert reason.mend.endswith(".")


def test_jumps_are_counted_in_words_and_for_unconfirmed_ones_no_error_is_expected():
    known = replace(CLEAN, jumps=2, jump_m=1.0, unconfirmed_jumps=(4, 9))
    judged = verdict.judge(known)
    assert judged.unknown
    assert (
        "jump twice, by up to 1.00 m; neither surfaces nor images determine the motion after scans 4, 9."
        in judged.reasons[0].text
    )
    assert "not known" in verdict_data.summary(judged, {"scans": {"position_m": 0.001}})
    assert "jump 3 times" in verdict.judge(replace(known, jumps=3)).reasons[0].text
    assert (
        "jump once, by 1.00 m."
        in verdict.judge(replace(known, jumps=1, unconfirmed_jumps=())).reasons[0].text
    )


@pytest.mark.parametrize(("of_ranges", "named"), [(0.76, "about 40 mm"), (0.4, ""), (None, "")])
def test_errors_of_ranges_are_named_where_they_are_most_of_what_is_expected(of_ranges, named):
    whole = math.hypot(0.76, 0.04)
    expected = {"scans": {"position_m": whole}, "of_ranges_m": of_ranges}
    said = verdict_data.summary(verdict.judge(CLEAN), expected)
    assert ("without such errors, scan poses are off by" in said) == bool(named)
    assert named in said
    small = {"scans": {"position_m": whole / 100}, "of_ranges_m": (of_ranges or 0.0) / 100}
    assert "beams" not in verdict_data.summary(verdict.judge(CLEAN), small)


def test_open_motions_are_named_where_they_are_most_of_what_is_expected():
    whole = math.hypot(0.3, 0.007)
    expected = {"scans": {"position_m": whole}, "along_open_m": 0.3, "of_ranges_m": 0.29}
    said = verdict_data.summary(verdict.judge(CLEAN), expected)
    assert "as in a corridor); there the scans follow the odometry. In all" in said
    assert "In all other directions scan poses are off by about 7.0 mm" in said
    assert "If the images are right" not in said
    said = verdict_data.summary(verdict.judge(CLEAN), expected | {"open_by_images_m": 0.022})
    assert "there the expected error is that of the odometry." in said
    assert said.endswith("If the images are right, the error along the open directions is about 22 mm.")
    said = verdict_data.summary(verdict.judge(CLEAN), expected | {"open_by": "images"})
    assert said.endswith(
        "there the scans follow the images. In all other directions scan poses are off by about 7.0 mm."
    )
    assert "corridor" not in verdict_data.summary(verdict.judge(CLEAN), expected | {"along_open_m": 0.1})


def test_the_worst_reason_comes_first():
    found = verdict.judge(
        replace(CLEAN, jumps=1, overdispersion=9.0, truth=(Truth("scans", "m", 0.09, 0.03, 0.02),))
    )
    assert [reason.level for reason in found.reasons] == ["bad", "check", "check", "check"]
    assert [reason.more for reason in found.reasons] == [False, True, True, False]


def facts(**more):
    """A report with what a verdict is made from."""
    per_image = {"ssim_common": [0.5, 0.52, 0.48, 0.51]}
    position = {"position_m": 0.00042, "position_p95_m": 0.0006, "rotation_deg": 0.001}
    expected = {
        "scans": position | {"per_frame_m": [0.0004] * 20},
        "cameras": position | {"per_frame_m": [0.0004] * 20},
        "map": {"position_m": 0.0025, "position_p95_m": 0.004},
    }
    return {
        "dataset": {"scans": 20, "images": 20},
        "lidar": {"accepted": True, "reason": "accepted", "degenerate_scans": [0] * 20, "degenerate_directions": [],
                  "odometry_dependence": [0.1] * 19, "converged": True, "history": [{"moved": 1e-5}]},
        "visual": {"accepted": True, "exposures_accepted": True,
                   "levels": [{"variance_factor": 20.0, "noise_variance_factor": 1.0, "converged": False},
                              {"variance_factor": 4.5, "noise_variance_factor": 4.0, "converged": True}],
                   "extrinsic": {"change_m": 0.01, "change_deg": 0.3, "sigmas": 1.2}},
        "fusion": {"accepted": True, "interpolation_error_scale": 0.3, "variance_factor": 1.0, "moved_m": [0.0]},
        "evaluation": {"rough": {"per_image": per_image}, "refined": {"per_image": per_image}},
        "expected_error": expected,
        "planes": {"thickness_before_m": 0.03, "thickness_after_m": 0.012},
        "odometry": {"jumps_after": [], "jumps_m": [], "jumps_deg": [], "unconfirmed_after": []},
    } | more  # fmt: skip


def test_a_clean_report_is_good_and_says_how_many_millimeters():
    found = verdict_data.add(facts())
    assert found["verdict"]["level"] == "good"
    assert found["verdict"]["reasons"] == []
    assert "about 2.5 mm in the map, 0.42 mm in the scan poses and" in found["verdict"]["summary"]
    assert found["alarms"]["overdispersion"] == {"value": 4.5 / 4.0, "limit": 1.6}
    assert found["expected_error"]["at_least"] is False


def alarmed(facts):
    facts["visual"]["levels"][-1]["variance_factor"] = 60.0


def open_scans(facts):
    facts["lidar"]["degenerate_scans"][:3] = [1, 2, 1]


def dependent(facts):
    facts["lidar"]["odometry_dependence"][7] = 0.9


def uncertain(facts):
    facts["expected_error"]["cameras"]["per_frame_m"][:2] = [0.002, None]


def moved(facts):
    facts["lidar"] |= {"converged": False, "history": [{"moved": 0.006}]}


def extrinsic(facts):
    facts["visual"]["extrinsic"] = {"change_m": 0.05, "change_deg": 0.3, "sigmas": 4.9}


def blurred(facts):
    facts["evaluation"] = dict(facts["evaluation"])
    facts["evaluation"]["refined"] = {"per_image": {"ssim_common": [0.41, 0.42, 0.38, 0.4]}}


def balanced(facts):
    facts["visual"]["white_balance"] = {"used": True, "change_percent": 7.31}
    facts["merge"] = {"parts": []}


def lost(facts):
    figures = {
        "psnr_leave_one_out": (-0.069, 0.011),
        "ssim_leave_one_out": (-0.0034, 0.0006),
        "map_entropy": (-1.0, 0.1),
    }
    facts["fusion"]["judged"] = [
        {"name": name, "gain": gain, "error": error} for name, (gain, error) in figures.items()
    ]


def jumped(facts):
    facts["odometry"] |= {"jumps_after": [5], "jumps_m": [0.4], "jumps_deg": [0.1]}


def rejected(facts):
    facts["lidar"] |= {
        "accepted": False,
        "cause": "the refined map is not sharper",
        "reason": "input poses kept: the refined map is not sharper",
    }


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (alarmed, "15.0 times"), (open_scans, "3 of 20 scans"), (dependent, "1 motions"), (uncertain, "2 of 20 cameras"),
        (moved, "6.0 mm"), (extrinsic, "5.0 cm"), (blurred, "lost structure"), (lost, "loss of 0.07"),
        (balanced, "by 7.3 %"), (jumped, "jump once, by 0.40 m"),
        (rejected, "not used: refined scan poses (the refined map is not sharper)"),
    ],
)  # fmt: skip
def test_what_a_report_tells_reaches_the_verdict(spoil, words):
    given = facts()
    spoil(given)
    found = verdict_data.add(given)["verdict"]
    assert found["level"] == "check"
    assert words in found["reasons"][0]["text"].replace("Not used", "not used")


@pytest.mark.parametrize(
    ("used", "after", "said"), [(True, 0.3, False), (True, 0.001, True), (False, 0.3, True)]
)
def test_scans_that_lost_with_the_cameras_of_the_input_need_no_look_where_later_ones_gain(used, after, said):
    given = facts()
    given["lidar"]["judged"] = [{"name": "ssim_leave_one_out", "gain": -0.05, "error": 0.01}]
    given["visual"]["accepted"] = used
    before = given["evaluation"]["rough"]["per_image"]["ssim_common"]
    given["evaluation"]["refined"] = {"per_image": {"ssim_common": [value + after for value in before]}}
    reasons = verdict_data.add(given)["verdict"]["reasons"]
    assert any("refined scans (loss of 0.0500" in reason["text"] for reason in reasons) == said


@pytest.mark.parametrize(
    ("after", "error", "thicker"),
    [
        (0.0111, 2e-5, False),  # less than 1 %
        (0.0112, 2e-5, True),
        (0.0112, 1.2e-4, False),  # within chance
        (0.0120, 1.2e-4, True),
        (0.0090, 1e-6, False),
    ],
)
def test_planes_are_thicker_beyond_chance_and_by_more_than_means_nothing(after, error, thicker):
    planes = {"thickness_before_m": 0.011, "thickness_after_m": after, "thickness_change_error_m": error}
    judged = verdict_data.add(facts(planes=planes))["verdict"]
    assert any("become thicker" in reason["text"] for reason in judged["reasons"]) is thicker


def test_a_white_balance_that_was_taken_out_of_all_images_needs_no_look():
    given = facts()
    balanced(given)
    del given["merge"]
    assert verdict_data.add(given)["verdict"]["reasons"] == []


def kept(**more):
    judged = [{"name": "map_entropy", "gain": 0.019, "error": 0.006, "finding": "neither"}]
    images = [{"name": "psnr_leave_one_out", "gain": 0.02, "error": 0.01, "finding": "neither"}]
    lidar = {"accepted": False, "cost_initial": 0.88, "cost_final": 0.85, "judged": judged,
             "history": [{"moved": 1e-5, "sigma": 0.0103}]}  # fmt: skip
    given = facts(
        expected_error=None, fusion={}, planes={"thickness_before_m": 0.0108, "thickness_after_m": 0.0108}
    )
    given["lidar"] |= lidar | more
    given["visual"] |= {"accepted": False, "judged": images}
    return given


def test_poses_that_nothing_betters_are_no_bad_result():
    verdict = verdict_data.add(kept())["verdict"]
    assert verdict["level"] == "check"
    assert "1.8 mm further off the planes" in verdict["reasons"][0]["text"]
    assert "Do not rely" not in verdict["summary"]


@pytest.mark.parametrize(
    "more",
    [
        {"cost_initial": 1.2},  # they are off by more than chance
        {"history": [{"moved": 1e-5, "sigma": 0.004}]},  # planes are thicker than the noise: walls are double
        {"judged": [{"name": "map_entropy", "finding": "worse", "gain": -0.1, "error": 0.01}]},
        {"judged": [{"name": "map_entropy", "finding": "unknown", "gain": 0.0, "error": 0.0}]},
        {"judged": []},
        {"converged": False},
        {"degenerate_scans": [1] * 20},
        {"odometry_dependence": [0.9] + [0.1] * 18},
    ],
)
def test_poses_that_something_speaks_against_are_a_bad_result(more):
    assert verdict_data.add(kept(**more))["verdict"]["level"] == "bad"


def test_where_motions_between_scans_stay_wrong_no_millimeters_are_expected():
    given = facts()
    error = {"step_m": 0.3, "step_deg": 2.0, "wrong_after": [4, 9], "open_after": [], "left_after": [9]}
    given["odometry"] |= {"too_far_off": error}
    verdict = verdict_data.add(given)["verdict"]
    assert verdict["level"] == "bad"
    assert verdict["summary"] == "Do not rely on this result. How large the errors are is not known."
    assert "1 motions from scan to scan contradict" in verdict["reasons"][0]["text"]
    given["odometry"]["too_far_off"]["left_after"] = []
    verdict = verdict_data.add(given)["verdict"]
    assert verdict["level"] == "check"
    assert "300 mm and 2.0 degrees" in verdict["reasons"][0]["text"]
    assert "Expect errors of about" in verdict["summary"]
    assert "perhaps" not in verdict["summary"]
    assert "scans were registered to each other first" in verdict["reasons"][0]["text"]
    given["odometry"]["too_far_off"]["by_images"] = [4, 5]
    text = verdict_data.add(given)["verdict"]["reasons"][0]["text"]
    assert "features of the images gave 2 motions from scan to scan instead" in text
    # one scan that nothing ties is no reason against the others
    given["odometry"]["too_far_off"]["unconnected_ends"] = [0, 39]
    verdict = verdict_data.add(given)["verdict"]
    assert verdict["level"] == "check"
    assert (
        "determine the pose of scans 0, 39 at the end of the recording relative to"
        in verdict["reasons"][0]["text"]
    )
    assert "perhaps more" in verdict["summary"]
    given["odometry"]["too_far_off"]["open_after"] = [7]
    verdict = verdict_data.add(given)["verdict"]
    assert verdict["level"] == "bad"
    assert "surfaces and images leave 1 motions" in verdict["reasons"][0]["text"]


def test_with_an_alarm_errors_may_be_larger_unless_images_refined_the_camera_too():
    given = facts()
    alarmed(given)
    found = verdict_data.add(given)
    assert "about 2.5 mm in the map" in found["verdict"]["summary"]
    assert "in the camera poses, perhaps more, relative to" in found["verdict"]["summary"]
    assert found["expected_error"]["at_least"] is True
    for name in ("focal", "distortion", "principal_point", "readout"):
        given = facts()
        alarmed(given)
        given["visual"]["calibration"] = {"sigma": {"scan_from_camera": [1e-3] * 6, name: [1e-3]}}
        found = verdict_data.add(given)
        assert "also with the camera refined" in found["verdict"]["reasons"][0]["text"]
        assert found["expected_error"]["at_least"] is False
    given["visual"]["calibration"]["sigma"].pop(name)
    assert verdict_data.add(given)["expected_error"]["at_least"] is True


def test_with_a_reference_the_truth_is_told_first():
    reference = {"lidar": {"ate_m": 0.03, "rotation_deg": 1.2, "rotation_alone_deg": 1.2,
                           "predicted_ate_m": 0.0004, "predicted_rotation_deg": 0.5}}  # fmt: skip
    found = verdict_data.add(facts(reference=reference))["verdict"]
    assert found["summary"].startswith("Against the reference, scans are off by 30 mm")
    assert "perhaps more" in found["summary"]
    assert "30 mm (expected: 0.40 mm)" in found["reasons"][0]["text"]
    assert "degrees" not in found["reasons"][0]["text"]


def test_of_an_empty_report_no_error_is_known():
    found = verdict_data.add({})
    assert "not known" in found["verdict"]["summary"]


@pytest.mark.parametrize(
    ("meters", "words"),
    [(0.000123, "0.12 mm"), (0.0042, "4.2 mm"), (0.0314, "31 mm"), (0.2, "200 mm"), (1.5, "1.5 m")],
)
def test_lengths_have_about_two_digits(meters, words):
    assert lengths.text(meters) == words


def test_figures_of_arrays_of_nothing_known_count_every_frame():
    given = facts()
    given["expected_error"]["scans"]["per_frame_m"] = [0.001] * 19 + [None]
    assert verdict_data.figures(given).uncertain_scans == 1


def test_cameras_are_alarmed_about_where_scans_are_not_used():
    """No error is predicted where neither is used; images that contradict each other count wherever cameras are."""
    off = replace(CLEAN, scan_poses=Judged(False, "not sharper"), overdispersion=190.0)
    texts = [
        [reason.text for reason in verdict.judge(replace(off, camera_poses=Judged(used, "why"))).reasons]
        for used in (True, False)
    ]
    assert [any("190.0 times" in text for text in each) for each in texts] == [True, False]


@pytest.mark.parametrize(
    ("ranges", "parts", "count"),
    [
        ({"corrected": ["incidence"]}, False, 0),
        ({"corrected": ["incidence", "offset"]}, True, 1),
        ({"corrected": ["elevation"]}, True, 0),
        ({"corrected": ["elevation"], "noticed": ["direction"]}, False, 1),
        ({"problem": "no error of the sensor explains what is left"}, False, 1),
        ({}, True, 0),
    ],
)
def test_errors_of_ranges_that_joint_rounds_correct_by_single_scans_are_told(ranges, parts, count):
    facts = {"lidar": {"range_errors": ranges}} | ({"merge": {"seams": []}} if parts else {})
    assert verdict_data.figures(facts).range_errors == count


def test_names_of_older_reports_are_read():
    names = {"uncertain_exposures": "vague_exposures", "unconfirmed_after": "untied_after"}
    known = []
    for old in (False, True):
        given = facts()
        far = {"loose_ends" if old else "unconnected_ends": [19]}
        given["visual"][names["uncertain_exposures"] if old else "uncertain_exposures"] = [3]
        given["odometry"] = {
            names["unconfirmed_after"] if old else "unconfirmed_after": [4],
            "too_far_off": far,
        }
        figures = verdict_data.figures(given)
        known.append((figures.uncertain_exposures, figures.unconfirmed_jumps, figures.unconnected_ends))
    assert known == [((3,), (4,), (19,))] * 2


def test_cameras_that_would_move_scans_along_an_open_corridor_reach_the_verdict():
    moved = {"accepted": False, "cause": "the map would be less sharp", "moved_m": [0.0, 0.3, 0.4]}
    judged = verdict.judge(
        verdict_data.figures(facts(fusion=moved, lidar=facts()["lidar"] | {"degenerate_directions": [{}]}))
    )
    assert judged.unknown
    assert "images contradict that. By them, scans are 289 mm elsewhere." in judged.reasons[0].text
