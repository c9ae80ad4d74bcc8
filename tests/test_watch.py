"""Films: a frame for each step, readable again; and which model, environment and statistics are used."""

import builtins
import shutil
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs import RandomSensors, tiny_model, vectors_space
from fake_drive import CONFIG, ENV_ID
from gymnasium import spaces
from PIL import Image
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_have import HAVESAC, train, watch
from sb3_have.algorithms import saved_algorithm
from sb3_have.checkpoint import save_checkpoint
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.evaluation.wrapping import saved_normalizer, wrap_as_trained
from sb3_have.plotting import Frames, animation, write_animation
from sb3_have.plotting.style import modality_colours

T = 6
VECTORS = "Vectors-v0"
gym.register(VECTORS, lambda **_: RandomSensors(vectors_space()))


def film(path: Path) -> tuple[np.ndarray, float]:
    """RGB frames (n, H, W, 3) and frames per second."""
    video = cv2.VideoCapture(str(path))
    frames: list[np.ndarray] = []
    while True:
        read, frame = video.read()
        if not read:
            return np.array(frames), video.get(cv2.CAP_PROP_FPS)
        frames.append(frame[..., ::-1])


def a_recording() -> Recording:
    """The first modality turns from black to white, and its weight grows."""
    observations = [
        {"rgb": np.full((8, 8, 3), 40 * t, np.uint8), "depth": np.full((8, 8, 1), 128, np.uint8)} for t in range(T)
    ]
    growing = np.linspace(0, 1, T)
    infos = [{"speed": 3.0 * t, "distance": 7.0 * t} for t in range(T)]
    weights, values = {"rgb": growing, "depth": 1 - growing}, {"q": np.stack([growing, growing - 2])}
    return Recording("fast", 0.2, observations, [], weights, infos, rewards=np.ones(T), values=values)


def near(pixels: np.ndarray, colour: str, tolerance: int = 90) -> np.ndarray:
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.asarray(np.abs(pixels.astype(int) - wanted).sum(-1) < tolerance)


@pytest.mark.parametrize("library", ["imageio_ffmpeg", "cv2"])
def test_mp4_has_a_frame_for_each_step(library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if library == "cv2":
        real = builtins.__import__

        def without(name: str, *args: Any) -> Any:
            if name == "imageio_ffmpeg":
                raise ImportError(name)
            return real(name, *args)

        monkeypatch.setattr(builtins, "__import__", without)
    else:
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "drive.mp4"
    write_animation(a_recording(), path, fps=7, width=241)
    frames, fps = film(path)
    assert len(frames) == T and frames.shape[2] == 240 and frames.shape[1] % 2 == 0 and fps == pytest.approx(7)
    drawn = Frames(a_recording(), 241)
    for step in (0, T - 1):
        assert np.abs(frames[step].astype(int) - np.asarray(drawn[step])).mean() < 6
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mp4"]


def test_frames_of_a_film_are_not_kept_and_a_broken_one_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(animation, "_write_with_ffmpeg", animation._write_with_opencv)
    drawn: list[weakref.ref[Image.Image]] = []

    def frames(breaks: bool) -> Iterator[Image.Image]:
        for _ in range(12):
            assert sum(frame() is not None for frame in drawn) <= 3
            frame = Image.new("RGB", (120, 80))
            drawn.append(weakref.ref(frame))
            yield frame
        if breaks:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        animation.write_mp4(tmp_path / "drive.mp4", frames(breaks=True), 10.0)
    assert len(drawn) == 12 and not list(tmp_path.iterdir())
    animation.write_mp4(tmp_path / "drive.mp4", frames(breaks=False), 10.0)
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mp4"]


def test_gif_has_every_step(tmp_path: Path) -> None:
    write_animation(a_recording(), tmp_path / "drive.gif", width=240)
    with Image.open(tmp_path / "drive.gif") as gif:
        assert (gif.n_frames, gif.width, gif.info["duration"]) == (T, 240, 200)  # type: ignore[attr-defined]
    write_animation(a_recording(), tmp_path / "fast.gif", fps=125, width=240)
    with Image.open(tmp_path / "fast.gif") as gif:
        assert gif.info["duration"] == 20  # less is shown slowly
    with pytest.raises(ValueError, match=r"\.avi: expected"):
        write_animation(a_recording(), tmp_path / "drive.avi")


def test_frames_show_images_weights_and_facts() -> None:
    frames, colour = Frames(a_recording(), 240), modality_colours(["rgb"])["rgb"]
    for step in range(T):
        pixels = np.asarray(frames[step])
        tile = pixels[frames.tile // 2 + frames._sensors + 18, frames.tile // 2]
        np.testing.assert_array_equal(tile, 40 * step)
        top = frames._sensors + 18
        assert (pixels[top, : frames.tile] == 0xBB).all() and (pixels[top : top + frames.tile, 0] == 0xBB).all()
        bars = near(pixels, colour, 30)[frames._top : frames._top + 18].sum(axis=1).max()
        assert bars == pytest.approx(frames.recording.weights["rgb"][step] * (frames.right - frames.left), abs=2)
        chart = near(pixels, colour, 30)[frames._top + 36 :]
        last = np.flatnonzero(chart.any(axis=0)).max(initial=frames.left)
        assert last == pytest.approx(frames.left + step / (T - 1) * (frames.right - frames.left), abs=3)
    # the return before the step, and the lower of the twins' values
    recording = a_recording()
    recording.values["q"][:] = -0.04
    assert Frames(recording, 400)._facts(0)[0].endswith("return 0.0 | Q 0.0")
    wide = Frames(a_recording(), 400)
    assert wide._facts(3) == ["fast | 0.6 s | 9 m/s | 21 m | return 3.0 | Q -1.4"]


@pytest.mark.parametrize("width", [120, 200])
def test_facts_of_a_narrow_frame_take_several_lines(width: int) -> None:
    narrow, wide = Frames(a_recording(), width), Frames(a_recording(), 640)
    lines = narrow._facts(3)
    assert len(lines) > 1 and " | ".join(lines) == wide._facts(3)[0]
    assert all(narrow.font.getlength(line) < width for line in lines)
    row = np.asarray(narrow[3])[18 * (len(lines) - 1) : 18 * len(lines)]
    assert (row.mean(axis=-1) < 100).any(), "the last of them is drawn"


def test_a_picture_of_its_own_stands_beside_the_sensors() -> None:
    recording = a_recording()
    for observation in recording.observations:
        observation["radar"] = np.zeros((8, 8, 1), np.uint8)
    assert list(Frames(recording)._tiles(0)) == ["rgb", "depth", "radar"]
    recording.pictures = [np.full((10, 20, 3), 77, np.uint8)] * T
    tiles = Frames(recording)._tiles(0)
    assert list(tiles) == ["", "rgb", "depth", "radar"] and tiles[""].shape == (10, 20, 3)
    with pytest.raises(ValueError, match="empty"):
        Frames(Recording("fast", 0.2))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short training run of ``sb3_have.train`` with its checkpoint."""
    out = tmp_path_factory.mktemp("run")
    config = {**CONFIG, "policy_kwargs": {"features_dim": 4, "net_arch": [8]}}
    train.Run(config, ENV_ID, out, eval_freq=0, save_freq=0).train(20)
    return out


def test_a_run_knows_its_environment(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "drive.gif"
    watch.main([str(run), "--out", str(out), "--seed", "4", "--weather", "slow", "--width", "240"])
    with Image.open(out) as gif:
        assert gif.n_frames == 8  # type: ignore[attr-defined]
    printed = capsys.readouterr().out
    assert f"{ENV_ID} {{'weather': 'slow'}}" in printed and "8 steps" in printed and "8 m" in printed
    watch.main([str(run / "model.zip"), "--out", str(out), "--steps", "3", "--env-kwargs", "weather:slow"])
    with Image.open(out) as gif:
        assert gif.n_frames == 3  # type: ignore[attr-defined]


def test_a_model_alone_is_matched_to_the_cameras_by_its_space() -> None:
    def images(**shapes: tuple[int, ...]) -> spaces.Dict:
        return spaces.Dict({name: spaces.Box(0, 255, shape, np.uint8) for name, shape in shapes.items()})

    stacked = images(event=(15, 48, 48), depth=(3, 48, 48))
    assert watch.fitting_env_kwargs(stacked) == {"modalities": ["event", "depth"], "image_size": 48}
    assert watch.fitting_env_kwargs(images(rgb=(40, 40, 3))) == {"modalities": ["rgb"], "image_size": 40}
    with pytest.raises(ValueError, match=r"reads a, b.*--env"):
        watch.fitting_env_kwargs(vectors_space())


def test_a_model_of_the_highway_is_driven_on_it(tmp_path: Path) -> None:
    space = spaces.Dict(
        {"rgb": spaces.Box(0, 255, (36, 36, 3), np.uint8), "depth": spaces.Box(0, 255, (36, 36, 1), np.uint8)}
    )
    tiny_model(space).save(tmp_path / "model")
    watch.main([str(tmp_path / "model"), "--out", str(tmp_path / "a.gif"), "--steps", "3", "--weather", "WetNoon"])
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 3 and gif.width == 640  # type: ignore[attr-defined]


def test_the_algorithm_is_found(tmp_path: Path) -> None:
    env = RandomSensors(vectors_space())
    SAC("MultiInputPolicy", env, buffer_size=10).save(tmp_path / "sac.zip")
    tiny_model(vectors_space()).save(tmp_path / "have.zip")
    PPO("MultiInputPolicy", env, n_steps=8, batch_size=8).save(tmp_path / "ppo.zip")
    for name, algo in (("sac", "sac"), ("have", "havesac")):
        assert saved_algorithm(tmp_path / f"{name}.zip", name) == algo
    model, settings = watch.load_model(tmp_path / "have.zip", device="cpu")
    assert isinstance(model, HAVESAC) and settings == {}
    with pytest.raises(ValueError, match="saved by sac, not by havesac"):
        watch.load_model(tmp_path / "sac.zip", "havesac")
    with pytest.raises(
        ValueError, match=r"ppo\.zip: its policy is from .*; supported algorithms: crossq, havesac, sac, tqc"
    ):
        watch.load_model(tmp_path / "ppo.zip", device="cpu")


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        watch.main(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def test_what_cannot_be_watched(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "a.gif")]
    (tmp_path / "text.zip").write_text("no model")
    assert "nothing is neither a model, nor a folder" in refused([str(tmp_path / "nothing"), *out], capsys)
    assert "not a model that SB3 saved" in refused([str(tmp_path / "text.zip"), *out], capsys)
    assert "ends in .mp4, .gif or .html" in refused([str(run), "--out", "film.avi"], capsys)
    assert "max_steps=0" in refused([str(run), *out, "--steps", "0"], capsys)
    assert "image_size" in refused([str(run), *out, "--env-kwargs", "image_size:40"], capsys)
    assert "NoSuch" in refused([str(run), *out, "--env", "NoSuch-v0"], capsys)
    assert "no configuration 'nothing'" in refused(
        [str(run), *out, "--env", watch.ENV_ID, "--config", "nothing"], capsys
    )
    assert "needs neither --algo nor --config" in refused(["have", *out, "--algo", "sac"], capsys)
    assert "needs neither --algo nor --config" in refused(["have", *out, "--config", "lve"], capsys)
    assert not list(tmp_path.glob("a.*"))


def test_a_checkpoint_and_the_model_beside_it_are_of_the_same_run(run: Path, tmp_path: Path) -> None:
    model, settings = watch.load_model(run / "model.zip", device="cpu")
    assert settings["env_id"] == ENV_ID and settings["config"]["frame_stack"] == 2
    from_checkpoint, same = watch.load_model(run / "checkpoint-20", device="cpu")
    assert same == settings
    for left, right in zip(model.policy.parameters(), from_checkpoint.policy.parameters(), strict=True):
        assert th.equal(left, right)
    # a model with another name may not belong to the run
    foreign = run / "night_driver.zip"
    foreign.write_bytes((run / "model.zip").read_bytes())
    assert watch.load_model(foreign, device="cpu")[1] == {}
    foreign.unlink()
    running = tmp_path / "running"  # no model.zip yet, so the newest checkpoint counts
    running.mkdir()
    (running / "checkpoint-20").write_bytes((run / "checkpoint-20").read_bytes())
    (running / "checkpoint-3").write_bytes(b"older")
    assert watch.model_file(running) == running / "checkpoint-20"
    with pytest.raises(FileNotFoundError, match=r"model\.zip or checkpoints"):
        watch.model_file(tmp_path)


def test_only_a_model_takes_precedence_over_a_trained_driver(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "write_animation", lambda *args, **kwargs: None)

    def watched(name: str) -> str:
        watch.main([name, "--steps", "2"])
        return capsys.readouterr().out

    (tmp_path / "have").mkdir()
    assert f"trained driver have in {watch.ENV_ID}" in watched("have")
    for path in ("./have", "have/"):
        assert f"{path} is neither a model, nor a folder" in refused([path], capsys)
    shutil.copy(run / "checkpoint-20", tmp_path / "have")
    for path in ("have", "./have", "have/"):
        assert f"have/checkpoint-20 in {ENV_ID}" in watched(path)
    shutil.rmtree(tmp_path / "have")
    tiny_model(vectors_space()).save("have")
    assert "the model reads a, b" in refused(["have"], capsys)


class Clipped(VecNormalize):
    """A subclass with another name."""


def test_statistics_of_a_subclass_and_at_another_place(tmp_path: Path) -> None:
    def saved(env: VecEnv) -> tuple[Any, VecNormalize | None]:
        model = tiny_model(vectors_space(), env=env)
        env.reset()
        save_checkpoint(model, tmp_path / "checkpoint")
        model.env = model._vec_normalize_env = None
        return model, saved_normalizer(tmp_path / "checkpoint")

    def make() -> VecEnv:
        return DummyVecEnv([lambda: gym.make(VECTORS)])

    env = Clipped(make())
    model, found = saved(env)
    assert found is not None and env.obs_rms["a"].mean.any()
    np.testing.assert_array_equal(found.obs_rms["a"].mean, env.obs_rms["a"].mean)
    assert wrap_as_trained(make(), model, found).observation_space == model.observation_space
    model, found = saved(VecFrameStack(VecNormalize(make()), 2))
    with pytest.raises(ValueError, match="broadcast"):
        record_episode(model, VECTORS, normalizer=found)


def test_statistics_of_the_training_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    env = VecNormalize(VecFrameStack(DummyVecEnv([lambda: gym.make(VECTORS)]), 2))
    model = tiny_model(vectors_space(), env=env)
    model.learn(30)
    expected = record_episode(model, VECTORS, seed=3).actions
    driven: list[Recording] = []

    def write(recording: Recording, *args: Any, **kwargs: Any) -> None:
        driven.append(recording)

    monkeypatch.setattr(watch, "write_animation", write)

    def film(file: Path, *more: str) -> str:
        watch.main([str(file), "--env", VECTORS, "--seed", "3", "--out", str(tmp_path / "a.gif"), *more])
        return capsys.readouterr().out

    save_checkpoint(model, tmp_path / "checkpoint-30")
    model.save(tmp_path / "best.zip")
    env.save(str(tmp_path / "elsewhere.pkl"))
    assert "normalized as in" in film(tmp_path / "checkpoint-30")
    assert "normalized" not in film(tmp_path / "best.zip")
    film(tmp_path / "best.zip", "--vecnormalize", str(tmp_path / "elsewhere.pkl"))
    folder = tmp_path / VECTORS  # of the Zoo
    folder.mkdir()
    (tmp_path / "elsewhere.pkl").rename(folder / "vecnormalize.pkl")
    film(tmp_path / "best.zip")
    (folder / "vecnormalize.pkl").rename(tmp_path / "vecnormalize.pkl")
    assert f"normalized as in {tmp_path / 'vecnormalize.pkl'}" in film(tmp_path / "best.zip")
    same = [np.array_equal(recording.actions, expected) for recording in driven]
    assert same == [True, False, True, True, True]
