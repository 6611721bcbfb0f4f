"""Commands that make captures and check them: `twofold studio`, `prepare`, `check`."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from twofold.cli.console import bar, console, say, within
from twofold.cli.datasets import SplitName, capture_from


def studio(
    out: Annotated[Path, tyro.conf.Positional],
    seed: int = 0,
    size: int = 256,
    frames: int = 80,
    cameras: int = 8,
    pose_noise: float = 0.0,
    mask_noise: float = 0.0,
    background: Literal["black", "textured"] = "black",
    yaw_range: float | None = None,
) -> None:
    """Make a capture of a synthetic subject, with ground truth of shape and pose.

    Args:
        out: Folder to make.
        seed: Seed of body, clothes and motion.
        size: Rows and columns of the images.
        frames: Number of frames; the last fifth shows a motion that is not trained on.
        cameras: In a ring around the person; the first one trains.
        pose_noise: Error of the given poses, radians (standard deviation).
        mask_noise: Faults of the masks, 0 to 1.
        background: What stands behind the person.
        yaw_range: Training images show the person from directions within this angle about the front, degrees; by
            default it turns twice about itself.
    """
    from twofold.studio.generate import StudioConfig, make_studio

    config = StudioConfig(seed, size, frames, cameras, pose_noise, mask_noise, background, yaw_range=yaw_range)
    with bar("Filming") as progress:
        make_studio(config, out, lambda done: progress(done, ""))
    say(f"The capture is in {out}.", f"twofold train {out}")


def prepare(
    videos: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    calibration: Path | None = None,
    fps: float | None = None,
    max_size: int = 960,
    intrinsics: str | None = None,
    body: str = "anny",
    masks: Path | None = None,
    landmarks: Path | None = None,
    poses: Path | None = None,
    track: int | None = None,
    smplx: Path | None = None,
    train_camera: str | None = None,
    held_out: int = 10,
    held_objects: Literal["keep", "remove"] = "remove",
    several_people: Literal["refuse", "ignore"] = "refuse",
    person: Literal["largest", "masks"] | int | None = None,
    drop: str | None = None,
    credit: str = "",
    refine_masks: Literal["auto", "off"] = "auto",
    landmark_model: Path | None = None,
) -> None:
    """Make a capture folder from a video of one person, or from several synchronised ones.

    Args:
        videos: A video file or a folder of images; several need --calibration.
        out: Capture folder to make.
        calibration: Cameras of several videos: Qualisys .qca.txt, intri.yml and extri.yml, Pose2Sim .toml, or JSON.
        fps: Images a second to use; by default all.
        max_size: Longer side of the images in pixels; larger ones are made smaller.
        intrinsics: fx,fy,cx,cy of the one camera in pixels of its video; found roughly where not given.
        body: anny, or your own SMPL file.
        masks: Your own masks instead of the estimator's: a folder (one folder for each of several videos in it).
        landmarks: Your own landmarks: a file (a folder with one file for each of several videos).
        poses: Your own poses of the body, and nothing is fitted: results of ROMP, 4D-Humans, WHAM, GVHMR, EasyMocap,
            or an npz with poses, translations and betas.
        track: Whom of several people in these poses, by the estimator's number; by default who is seen longest.
        smplx: Your own SMPL-X file, which the results of GVHMR need.
        train_camera: Which of several videos trains; by default the first.
        held_out: Every Nth frame is held out for testing.
        held_objects: Whether a ball or the like that moves apart from the body is taken out of the masks.
        several_people: What a second person in view means: refuse the video, or take whoever is found.
        person: Which of several people is meant: the largest, a number (1 is the leftmost in the first image), or the
            one in your own masks; by default the one in your own masks, landmarks or poses.
        drop: Frames to leave out of the splits, such as 3,7-9.
        credit: Whom to name when showing the images.
        refine_masks: auto sharpens the estimator's masks by the background where the camera stands still.
        landmark_model: Your own file of another BlazePose landmark model (.tflite or .task), such as "heavy".
    """
    from twofold.capture.folder import read_capture
    from twofold.check.body_pictures import write_fit_picture
    from twofold.prepare.detect.blazepose import mediapipe_estimator
    from twofold.prepare.detect.landmark_model import read_landmark_model
    from twofold.prepare.detect.people import count_people
    from twofold.prepare.pipeline import prepare as make
    from twofold.prepare.pipeline import read_body
    from twofold.prepare.video.clips import PrepareConfig, read_frames, read_intrinsics

    config = PrepareConfig(
        fps, max_size, read_intrinsics(intrinsics), calibration, train_camera, held_out, held_objects, credit,
        masks, landmarks, poses, track, smplx, several_people, person, read_frames(drop), refine_masks,
    )  # fmt: skip
    estimator = partial(
        mediapipe_estimator, model=None if landmark_model is None else read_landmark_model(landmark_model)
    )
    with bar("Preparing") as progress:
        prepared = make(videos, out, read_body(body), estimator, config, progress, count_people)
    picture = write_fit_picture(read_capture(out), out, prepared.standing.floor)
    for sentence in prepared.warnings:
        console().print(f"Note: {sentence}", soft_wrap=True)
    if prepared.focal:
        console().print(prepared.focal, soft_wrap=True)
    console().print(f"{prepared.standing.sentence()} From the side and from above: {picture}", soft_wrap=True)
    say(f"The capture is in {out}: {prepared.summary()}", f"twofold check {out}")


def check(
    capture: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    max_images: int = 100,
    write_splits: bool = False,
    body: Path | None = None,
    split: SplitName | None = None,
) -> None:
    """Check whether a capture is worth training on, and report what to fix; exit code 1 where it is not trainable.

    Args:
        capture: Capture folder, or a data set that `twofold convert` knows; captures/NAME is made of that first.
        out: Folder for the report and its metrics; by default CAPTURE/check.
        max_images: Images to check, evenly spread.
        write_splits: Whether images that findings advise to leave out are taken out of the capture's splits.
        body: Your own SMPL file, for a data set.
        split: Whose training and test images, for a data set.
    """
    from twofold.capture.splits import leave_out
    from twofold.check.check_report import require_no_file, write_check
    from twofold.check.findings import places_of
    from twofold.check.measure import measure_capture
    from twofold.check.rules import judge

    within(max_images=(max_images, 2, None))
    capture = capture_from(capture, body, split)
    require_no_file(out or capture / "check")
    with bar("Checking") as progress:
        facts, read = measure_capture(capture, max_images, lambda done: progress(0.9 * done, ""))
        judgement = judge(facts)
        page = write_check(facts, read, judgement, out or capture / "check")
        progress(1.0, "")
    for finding in judgement.findings:
        console().print(f"{finding.level}: {finding}", soft_wrap=True)
    console().print(f"{100 * facts.coverage:.0f} % of the surface is shown well by training images.", soft_wrap=True)
    console().print(judgement.words, soft_wrap=True)
    if write_splits and judgement.unfit:
        left = leave_out(capture, judgement.unfit)
        say(
            f"{len(left)} of the images checked are left out of the splits of {capture / 'capture.json'}: "
            f"{places_of(left)}.",
            f"twofold check {capture}",
        )
        return
    if write_splits:
        console().print("No image has to be left out; the splits stay as they are.", soft_wrap=True)
    untrainable = judgement.level == "not trainable"
    say(f"The report is {page}.", "fix what it names and check again" if untrainable else f"twofold train {capture}")
    if untrainable:
        sys.exit(1)
