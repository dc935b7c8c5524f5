"""`forcegp fit`: fit a model to a log; `forcegp sweep`: fit many models on a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

import forcegp
from forcegp.cli import common, options
from forcegp.cli.common import progress_bar, rounded, say, show, show_table
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
    else:
        summary = _summary(learned, regression.name, len(training))
        summary |= _details(learned.result) if verbose else {}
    show({**summary, "file": str(model_path(out))}, as_json)


CLEAR = 2.0
"""Number of standard deviations from zero beyond which a parameter is listed."""
GROUPS = ("torque scale", "torque delay", "torque offset", "drive inertia", "link", "payload")
"""First words of the parameters that are listed together."""
FRICTION = ("slow friction", "fast friction")
UNITS = {"revolute": "friction and noise in N m at speeds in rad/s", "prismatic": "N at m/s if sliding"}
"""Units of the table of friction, by type of joint."""
NOT = "–"
"""Mark of friction that the log does not determine."""


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


def _details(result: FitResult) -> dict[str, object]:
    """Return the numbers of the computation as lines, without the warnings, which are printed before."""
    worth = "".join(f"\n  {name}: {nats:.3g} nats" for name, nats in result.worth.items())
    return {**_numbers(result), "worth": worth, "warnings": None}


def _summary(learned: FittedModel, name: str, rows: int) -> dict[str, object]:
    """Print the friction of each joint, and return the other parameters, the noise and the duration."""
    from forcegp.models.structured_fit import StructuredFit
    from forcegp.plots import unit

    result = learned.result
    part = "" if result.samples in (None, rows) else f"{result.samples} rows in motion, of "
    lines: dict[str, object] = {"model": f"{name}, learned from {part}{rows} rows in {result.seconds:.2g} s"}
    if isinstance(learned, StructuredFit):
        parameters = learned.robot_parameters()
        _show_joints(learned, parameters)
        groups = {group: [p for p in parameters if p.name.startswith(group)] for group in GROUPS}
        others = [p for p in parameters if not p.name.startswith((*GROUPS, *FRICTION))]
        for contact in learned.system.contact_names:
            groups[f"contact {contact}"] = [p for p in others if p.of == contact]
        lines |= {group: _listed(listed) for group, listed in groups.items() if listed}
        if not parameters:
            lines["forces"] = ", ".join(prior.name for prior in learned.force_priors)
        kinds = learned.system.robot.joint_types
        for quantity, std in learned.noise.items():
            size = float(std.mean())
            lines[f"noise of {quantity}"] = f"{size:.3g} {unit(quantity, kinds)}" if size > 0.0 else None
    return lines


def _show_joints(learned: StructuredFit, parameters: Sequence[RobotParameter]) -> None:
    """Print a table of the friction and the torque noise of each joint."""
    import torch

    friction = {(p.of, p.name): p for p in parameters if p.name in FRICTION}
    if not friction:
        return
    robot, noise, rows = learned.system.robot, learned.torque_std, [["joint", *FRICTION, "torque noise"]]
    tau = torch.cat([m.tau for m in learned.training.measurements])
    for j, joint in enumerate(robot.joint_names):
        if not bool(robot.driven[j]):
            continue
        each = (friction.get((joint, name)) for name in FRICTION)
        cells = [f"{rounded(p.value, p.std)} at {p.speed:.2g}" if p and p.determined else NOT for p in each]
        size = "" if noise is None else f"{float(noise[j]):.2g}"
        share = f" ({float(noise[j] / tau[:, j].std()):.0%})" if noise is not None and tau[:, j].any() else ""
        rows.append([joint, *cells, f"{size}{share}"])
    show_table(rows)
    units = ", ".join(dict.fromkeys(UNITS[kind] for kind in robot.joint_types))
    missing = f"; {NOT}: not determined" * any(NOT in row for row in rows)
    say(f"{units}; ± is one σ; (%) of the torque's σ{missing}")


def _listed(parameters: Sequence[RobotParameter]) -> str:
    """Return the parameters that are clear, and the names of those that the log does not determine."""

    def label(p: RobotParameter) -> str:
        word = p.name.removeprefix("link ").removeprefix("payload ")
        return f"{p.of} {word}" if word != p.name else p.of if p.name in GROUPS else p.name

    known = [p for p in parameters if p.determined and abs(p.value) > CLEAR * (p.std or 0.0)]
    texts = [f"{label(p)} {rounded(p.value, p.std)} {p.unit}".strip() for p in known]
    links = parameters[0].name.startswith(("link ", "payload "))
    # Most parameters of single links and payloads are never determined.
    missing = [label(p) for p in parameters if not p.determined and not links]
    if len(missing) == len(parameters):
        return "not determined"
    text = ", ".join(texts) or f"no{' change' if links else 'ne'} beyond {CLEAR:g}σ"
    return f"{text}; not determined: {', '.join(missing)}" if missing else text


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
