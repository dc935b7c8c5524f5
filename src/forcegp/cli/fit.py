"""`forcegp fit`: fit a model to a log; `forcegp sweep`: fit many models on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli import common, options
from forcegp.cli.common import Verbatim, progress_bar, rounded, say, show, show_table, terminal_width
from forcegp.errors import ParameterError

if TYPE_CHECKING:
    from forcegp.models.base import FittedModel, Model
    from forcegp.models.fit_result import FitResult
    from forcegp.models.robot_parameters import RobotParameter
    from forcegp.models.structured_fit import StructuredFit

STREAM_ROWS = 100_000
"""Number of rows above which a log is read piece by piece."""


def fit(
    data: options.DataFiles,
    out: Annotated[
        Path, Option("--out", "-o", writable=True, help="File for the fitted model (.safetensors).")
    ],
    scene: options.SceneOrNone = None,
    robot: options.RobotName = None,
    model: Annotated[
        str | None,
        Option(
            "--model",
            "-m",
            help="analytical, nn, gp, sgp or sgp-zero; from the paper: sgp-mean, sgp-contact or, with the "
            "paper's kernel, sgp-zero-se, sgp-mean-se, sgp-contact-se. Default: from the file, or sgp.",
        ),
    ] = None,
    config: options.Config = None,
    noise_std: Annotated[
        float | None,
        Option(help="Standard deviation of acceleration noise [rad/s²]; default: from the file or data."),
    ] = None,
    differentiate: options.Differentiate = None,
    workers: Annotated[
        int | None,
        Option(min=1, help="Number of processes that share the reading of a long log (needs Dask)."),
    ] = None,
    seed: Annotated[int | None, Option(help="Seed for random initial values.")] = None,
    verbose: options.Verbose = False,
    as_json: options.AsJson = False,
) -> None:
    """Fit a model of the forward dynamics to logged motion.

    The table \\[model] in the scene or in --config defines priors, kernels, noise, robot parameters and
    learning. Command-line options override its entries.

    For structured models, Parquet logs are read piece by piece if they have more than 100,000 rows or consist
    of several files.

    **Examples**

    forcegp fit --scene kuka_plane --data train.parquet --model sgp --out model

    forcegp fit --robot ur3.urdf -d train.parquet --config model.toml --noise-std 0.2 -o model --json

    forcegp fit -s my_scene.toml -d monday.parquet -d tuesday.parquet --workers 2 -o model
    """
    from forcegp.cluster import cluster
    from forcegp.destination import check_destination
    from forcegp.models.configured import configured
    from forcegp.storage.model_file import model_path

    check_destination(model_path(out))
    system = common.system_of(scene, robot)
    table = common.model_table(config, scene)
    regression = configured(table, system, name=model, noise_std=noise_std, seed=seed)
    training = _training(regression.model, data, differentiate, system.robot)
    if workers is not None and not isinstance(training, forcegp.StreamedDataset):
        raise ParameterError(
            "--workers has no effect on this fit, which reads its log at once",
            expected=f"a structured model, and several Parquet files or one over {STREAM_ROWS:,} rows",
            hint="omit --workers",
        )
    with nullcontext() if workers is None else cluster(workers) as client:
        learned = common.fitted(regression, training, **({} if client is None else {"client": client}))
    common.save(learned.save, out)
    doubts = () if learned.result.converged else (f"the fit did not converge: {learned.result.message}",)
    for doubt in (*doubts, *learned.result.warnings):
        common.warn(doubt)
    if as_json:
        summary = {"model": regression.name, "training_points": len(training), **_complete(learned)}
        summary["file"] = str(model_path(out))
    else:
        summary = _summary(learned, regression.name, training, model_path(out))
        summary |= _details(learned) if verbose else {}
    show(summary, as_json)


CLEAR = 2.0
"""Number of standard deviations from zero beyond which a parameter is listed."""
LISTED = 3
"""Maximum number of values in a list. The others are counted."""
GROUPS = (
    "torque constant",
    "torque scale",
    "torque delay",
    "torque offset",
    "drive inertia",
    "link",
    "payload",
)
"""First words of the parameters of joints and links that are listed together."""
FRICTION = ("slow friction", "fast friction")
UNITS = {"revolute": "friction and noise in N m at speeds in rad/s", "prismatic": "N at m/s if sliding"}
"""Units of the table of friction, by type of joint."""
NOT = "–"
"""Mark of friction that the log does not determine."""
ALL = "all"
"""Mark of a group that the log does not determine at all."""
FORCE_SAMPLES = 300
"""Maximum number of training samples whose normal force is predicted."""
OPEN_LOOP = 0.3
"""Time after which the motion in open loop is printed [s]."""


def _complete(learned: FittedModel) -> dict[str, object]:
    """Return the complete result of a fit, for programs."""
    from forcegp.models.structured_fit import StructuredFit

    result = _numbers(learned.result)
    if isinstance(learned, StructuredFit):
        result["torque_noise"] = None if learned.torque_std is None else learned.torque_std.tolist()
        result["robot_parameters"] = [vars(each) for each in learned.robot_parameters()]
    return result


def _numbers(result: FitResult) -> dict[str, object]:
    return {name: value for name, value in asdict(result).items() if name != "history"}


def _details(learned: FittedModel) -> dict[str, object]:
    """Print the joints, and return the numbers of the computation, without the warnings, printed before."""
    from forcegp.models.structured_fit import StructuredFit
    from forcegp.plots import unit

    noise: dict[str, object] = {}
    if isinstance(learned, StructuredFit):
        _show_joints(learned)
        kinds = learned.system.robot.joint_types
        sizes = {quantity: float(std.mean()) for quantity, std in learned.noise.items()}
        noise = {f"noise of {name}": f"{x:.3g} {unit(name, kinds)}" for name, x in sizes.items() if x > 0.0}
    worth = "".join(f"\n  {name}: {nats:.3g} nats" for name, nats in learned.result.worth.items())
    return {**noise, **_numbers(learned.result), "worth": worth, "warnings": None}


def _summary(
    learned: FittedModel, name: str, data: forcegp.Dataset | forcegp.StreamedDataset, out: Path
) -> dict[str, object]:
    """Print the friction of each joint, and return what else was learned, its accuracy, and what was not."""
    from forcegp.models.structured_fit import StructuredFit

    result, rows = learned.result, len(data)
    part = "" if result.samples in (None, rows) else f"{result.samples} of "
    lines: dict[str, object] = {
        "model": f"{out}: {name}, learned from {part}{rows} rows in {result.seconds:.2g} s"
    }
    if not isinstance(learned, StructuredFit):
        return lines
    parameters = learned.robot_parameters()
    _show_friction(learned, parameters)
    others = [p for p in parameters if p.name not in FRICTION]
    names = dict.fromkeys((*GROUPS, *(p.name for p in others if not p.name.startswith(GROUPS))))
    groups = {group: [p for p in others if p.name.startswith(group)] for group in names}
    if groups["torque constant"]:
        del groups["torque scale"]
    short = learned.system.robot.joint_names
    short = dict(zip(short, _short(short), strict=True))
    listed = {group: _listed(members, short) for group, members in groups.items() if members}
    known = [text for text, _ in listed.values() if text]
    none = [group for group, (text, rest) in listed.items() if not text and rest != ALL]
    known += [f"none beyond {CLEAR:g}σ: {', '.join(none)}"] if none else []
    missing = [group if rest == ALL else f"{group} of {rest}" for group, (_, rest) in listed.items() if rest]
    lines["learned"] = "; ".join(known)
    if not parameters:
        lines["learned"] = f"forces {', '.join(prior.name for prior in learned.force_priors)}"
    lines["accuracy"] = "; ".join(_accuracy(learned, data))
    lines["undetermined"] = "; ".join(missing)
    return lines


def _show_friction(learned: StructuredFit, parameters: Sequence[RobotParameter]) -> None:
    """Print the friction of each joint, and its torque error relative to its torque, in several columns."""
    friction = {(p.of, p.name): p for p in parameters if p.name in FRICTION}
    if not friction:
        return
    robot, shares = learned.system.robot, _torque_errors(learned)
    driven = [j for j in range(robot.nq) if bool(robot.driven[j])]
    cells = []
    for j, name in zip(driven, _short([robot.joint_names[j] for j in driven]), strict=True):
        pair = [friction.get((robot.joint_names[j], word)) for word in FRICTION]
        std = max((p.std for p in pair if p and p.determined and p.std), default=None)
        each = [rounded(p.value, std).split(" ± ") if p and p.determined else [NOT] for p in pair]
        spread = next((f"±{value[1]}" for value in each if len(value) > 1), "")
        error = "" if shares is None else f"{shares[j]:.0%}"
        cells.append([name, *(value[0] for value in each), spread, error])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    texts = [
        f"{name:<{widths[0]}} " + " ".join(f"{x:>{w}}" for x, w in zip(values, widths[1:], strict=True))
        for name, *values in cells
    ]
    across = max(1, (terminal_width() + 3) // (len(texts[0]) + 3))
    down = -(-len(texts) // across)
    units = ["N m" if robot.joint_types[j] == "revolute" else "N" for j in driven]
    source = "held-out" if learned.specification.noise.learns_torque else "stated"
    error = "" if shares is None else f"; {source} torque error [% of torque σ]"
    missing = f"; {NOT}: undetermined" * any(NOT in cell for cell in cells)
    say(f"friction [{', '.join(dict.fromkeys(units))}], slow and fast motion, ±σ{error}{missing}")
    for k in range(down):
        say(Verbatim("   ".join(texts[k::down]).rstrip()))


def _torque_errors(learned: StructuredFit) -> list[float] | None:
    """Return the torque noise of each joint relative to the standard deviation of its torque, if known."""
    import torch

    if learned.torque_std is None or not learned.training.samples:
        return None
    tau = torch.cat([m.tau for m in learned.training.measurements])
    return (learned.torque_std / tau.std(0).clamp(min=1e-12)).tolist()


def _short(names: Sequence[str]) -> list[str]:
    """Return names without their common first and last words, if they remain distinct.

    >>> _short(["shoulder_pan_joint", "elbow_joint"]), _short(["arm_joint_1", "arm_joint_2"]), _short(["a_1"])
    (['shoulder_pan', 'elbow'], ['joint 1', 'joint 2'], ['a_1'])
    """
    words = [name.split("_") for name in names]
    first, last = (
        sum(1 for _ in takewhile(lambda each: len(set(each)) == 1, zip(*part, strict=False)))
        for part in (words, [each[::-1] for each in words])
    )
    short = ["_".join(each[first : len(each) - last]) for each in words]
    if not all(short) or len(set(short)) < len(names):
        return list(names)
    return [f"joint {each}" if each.isdigit() else each for each in short]


def _accuracy(learned: StructuredFit, data: forcegp.Dataset | forcegp.StreamedDataset) -> Iterator[str]:
    """Yield the errors in open loop on the training motion, and the standard deviation of normal forces."""
    motion = None
    if not isinstance(data, forcegp.StreamedDataset) and data.header.ordered:
        from forcegp.evaluation import open_loop

        motion = open_loop(learned, learned.specified, data)
    if motion is not None and OPEN_LOOP in motion.horizons:
        k = motion.horizons.index(OPEN_LOOP)
        model, file = (_share(shares[k]) for shares in (motion.model, motion.robot_file))
        yield f"open loop: off by {model} of the training motion after {OPEN_LOOP:g} s (robot file: {file})"
    stds = list(_force_std(learned))
    if stds:
        low, high = (f"{x:.2g}" for x in (min(stds), max(stds)))
        yield f"normal force ± {low if low == high else f'{low} to {high}'} N (σ)"


def _share(share: float | None) -> str:
    return "over 100%" if share is None or share > 1.0 else f"{share:.0%}"


def _force_std(learned: StructuredFit) -> Iterator[float]:
    """Yield the mean standard deviation of each normal force in training samples in contact [N]."""
    import torch

    if not learned.system.contacts or not learned.training.samples:
        return
    parts = learned.training.evenly(FORCE_SAMPLES).measurements
    q, qd, tau, active = (torch.cat([getattr(m, x) for m in parts]) for x in ("q", "qd", "tau", "active"))
    noise = learned.torque_std is not None
    force = learned.predict(q, qd, tau, "multiplier", active=active, noise=noise)
    for k, contact in enumerate(learned.system.contacts):
        closed, rows = active[:, k], learned.system.rows[contact.name]
        if isinstance(contact, forcegp.SurfaceContact) and bool(closed.any()) and force.std is not None:
            yield float(force.std[closed][:, rows].mean())


def _show_joints(learned: StructuredFit) -> None:
    """Print a table of the friction, with its speeds, and of the torque noise of each joint."""
    friction = {(p.of, p.name): p for p in learned.robot_parameters() if p.name in FRICTION}
    if not friction:
        return
    robot, noise, rows = learned.system.robot, learned.torque_std, [["joint", *FRICTION, "torque noise"]]
    for j, joint in enumerate(robot.joint_names):
        if not bool(robot.driven[j]):
            continue
        each = (friction.get((joint, name)) for name in FRICTION)
        cells = [f"{rounded(p.value, p.std)} at {p.speed:.2g}" if p and p.determined else NOT for p in each]
        rows.append([joint, *cells, "" if noise is None else f"{float(noise[j]):.2g}"])
    show_table(rows)
    say(f"{', '.join(dict.fromkeys(UNITS[kind] for kind in robot.joint_types))}; ± is one σ")


def _listed(parameters: Sequence[RobotParameter], short: Mapping[str, str]) -> tuple[str, str]:
    """Return the clear parameters of a group, and the names of those that the log does not determine.

    Args:
        parameters: parameters of a group.
        short: short names of the joints.
    """

    def label(p: RobotParameter) -> str:
        word = p.name.removeprefix("link ").removeprefix("payload ")
        return " ".join(x for x in (short.get(p.of, p.of), word if word != p.name else "") if x)

    known = [p for p in parameters if p.determined and abs(p.value) > CLEAR * (p.std or 0.0)]
    known.sort(key=lambda p: -abs(p.value) / (p.std or abs(p.value)))
    group = next((name for name in GROUPS if parameters[0].name.startswith(name)), parameters[0].name)
    units = {p.unit for p in known}
    (unit,) = units if len(units) == 1 else ("",)
    texts = [f"{label(p)} {rounded(p.value, p.std)} {'' if unit else p.unit}".strip() for p in known]
    links = group in ("link", "payload")
    # Most parameters of single links and payloads are never determined.
    missing = [label(p) for p in parameters if not p.determined and not links]
    heading = f"{group} [{unit}] " if unit else f"{group} "
    rest = ALL if missing and len(missing) == len(parameters) else _first(missing)
    return heading * bool(texts) + _first(texts), rest


def _first(texts: Sequence[str]) -> str:
    """Return the first texts, and the number of the others."""
    more = [f"{len(texts) - LISTED} more"] if len(texts) > LISTED else []
    return ", ".join([*texts[:LISTED], *more])


def _training(
    regression: Model, files: list[Path], differentiate: int | None, robot: forcegp.RobotModel
) -> forcegp.Dataset | forcegp.StreamedDataset:
    """Return the training data, streamed if they are large and the model supports streaming."""
    parquet = all(file.suffix.lower() == ".parquet" for file in files)
    if parquet and isinstance(regression, forcegp.StructuredGP):
        log = forcegp.StreamedDataset(tuple(files), common.derivatives(differentiate), robot.joint_names)
        if len(files) > 1 or len(log) > STREAM_ROWS:
            return log
    parts = [common.read_data(file, robot, differentiate) for file in files]
    return parts[0] if len(parts) == 1 else forcegp.Dataset.concatenate(parts)


def sweep(
    scene: Annotated[list[str], Option("--scene", "-s", help="Scene; may be given several times.")],
    model: Annotated[list[str], Option("--model", "-m", help="Model; may be given several times.")],
    out: Annotated[Path, Option("--out", "-o", writable=True, help="Folder for the fits.")],
    seeds: Annotated[int, Option(min=1, help="Number of seeds, starting from 0.")] = 1,
    duration: options.SimulatedTime = None,
    processes: Annotated[int, Option(min=1, help="Number of single-threaded workers on this machine.")] = 2,
    address: Annotated[
        str | None, Option(help="Scheduler of a running cluster, instead of local workers.")
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Simulate several scenes, and fit and score several models on each, with several seeds.

    Completed fits are not repeated. This command requires the extra `sweep` (Dask).

    **Examples**

    forcegp sweep --scene kuka_plane --model sgp-zero --model sgp --seeds 3 --out sweep/

    forcegp sweep -s kuka_plane -s ur5_wiping -m sgp --address tcp://host:8786 --out /shared/sweep
    """
    from forcegp.destination import check_destination
    from forcegp.sweep import fits_of
    from forcegp.sweep import sweep as run

    check_destination(out, folder=True)
    fits = fits_of(scene, model, range(seeds), duration)
    with progress_bar("sweeping", len(fits)) as progress:
        scores = run(fits, out, processes=processes, address=address, say=lambda done, _: progress(done))
    pairs = zip(fits, scores, strict=True)
    errors = {fit.name: score["clean_mae"] or score["noisy_mae"] for fit, score in pairs}
    show({**errors, "folder": str(out)}, as_json)
