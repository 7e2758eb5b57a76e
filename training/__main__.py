"""`python -m training generate|pack|unpack|fit|mean|centring|second-look|evaluate|compare`: labels, weights, rates."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from simharness.errors import SimError
from simharness.sim.camera import PRESETS
from simharness.sim.sensors.catalogue import SENSORS
from tesnet import networks
from tesnet.cloud import PreparationConfig
from tesnet.errors import TesnetError
from tesnet.hands import HANDS
from training.archive import is_archive, pack, unpack
from training.centring import EPOCHS as CENTRING_EPOCHS
from training.centring import learn_centring
from training.compare import compare
from training.evaluate import evaluate
from training.fit import PRESETS as RECIPES
from training.fit import fit
from training.generate import GenerateConfig, generate
from training.mean import mean
from training.second_look import EPOCHS as SECOND_LOOK_EPOCHS
from training.second_look import learn_second_look
from training.viewing import RANDOM, RANDOM_POSE, MoreViews
from training.views import Fold, LabelsError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns 0, or 2 after printing why its input cannot be used."""
    options = _parser().parse_args(arguments)
    try:
        result = options.run(options)
    except (LabelsError, SimError, TesnetError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result, indent=2))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m training", description=__doc__)
    commands = parser.add_subparsers(required=True)
    _add_generate(commands.add_parser("generate", help="simulate grasps and store their outcomes"))
    _add_pack(commands.add_parser("pack", help="put stored labels into a small archive"))
    _add_unpack(commands.add_parser("unpack", help="render the clouds of an archive again"))
    _add_fit(commands.add_parser("fit", help="train a network on stored labels"))
    _add_mean(commands.add_parser("mean", help="average weights that were trained one from another"))
    _add_centring(commands.add_parser("centring", help="fit the network that tells where hands stand"))
    _add_second_look(commands.add_parser("second-look", help="fit what looks at the best candidates again"))
    _add_evaluate(commands.add_parser("evaluate", help="measure a network on stored labels"))
    _add_compare(commands.add_parser("compare", help="put trained networks side by side: table and figure"))
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not positive")
    return value


def _fold(text: str) -> Fold:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not int(found[1]) < int(found[2]) > 1:
        raise argparse.ArgumentTypeError(f"{text} is no fold; give 0/2 or 1/2, say")
    return Fold(int(found[1]), int(found[2]))


def _share(text: str) -> float | None:
    if text == "natural":
        return None
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not in 0 to 1")
    return value


def _above_zero(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def _limits(given: list[float] | None, name: str) -> tuple[float, float] | None:
    if given is None:
        return None
    low, high = given
    if low > high:
        raise LabelsError(f"--{name} {low:g} {high:g}: the first is larger than the second; give the smaller one first")
    return low, high


def _add_generate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", choices=("packed", "pile"), required=True)
    parser.add_argument("--objects", required=True, help="object sets, joined with commas: names, folders or lists")
    parser.add_argument("--exclude", type=Path, help="list of objects that no scene may hold")
    parser.add_argument("--labels", type=_positive, required=True, help="how many, all runs on --out together")
    parser.add_argument("--views", type=_positive, default=2, help="camera views of each scene")
    parser.add_argument("--labels-per-view", type=_positive, default=320)
    parser.add_argument(
        "--colliding-share",
        type=_share,
        default=0.7,
        help="part of the labels from candidates that the observed cloud blocks; 'natural' draws from all alike",
    )
    parser.add_argument(
        "--mine", type=Path, metavar="WEIGHTS", help="draw half of the others from what these score best"
    )
    parser.add_argument(
        "--model",
        default="tesnet",
        choices=networks.NETWORKS,
        help="prepare the clouds as this network wants them (with --mine: as that one does)",
    )
    _add_camera(parser, "of the labels")
    parser.add_argument(
        "--gripper",
        choices=(*HANDS, "random"),
        default="franka",
        help="the hand that tries the grasps; 'random': a new one each scene",
    )
    for name, words in (("scale", "scale"), ("mass", "mass in kilograms"), ("friction", "coefficient of friction")):
        parser.add_argument(
            f"--{name}",
            type=_above_zero,
            nargs=2,
            metavar=("LOW", "HIGH"),
            help=f"draw each object's {words} between these (default: the protocol's)",
        )
    parser.add_argument(
        "--things", type=_positive, metavar="N", help="1 to N objects a table, all alike (default: up to 5)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=_positive, default=1)
    parser.add_argument("--ray", metavar="ADDRESS", help="make the scenes on this Ray cluster")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--resume", action="store_true", help="go on where an earlier run stopped")
    parser.set_defaults(run=_generate)


def _generate(options: argparse.Namespace) -> dict[str, object]:
    config = GenerateConfig(
        scene=options.scene,
        objects=options.objects,
        exclude=options.exclude,
        seed=options.seed,
        views=options.views,
        labels_per_view=options.labels_per_view,
        colliding_share=options.colliding_share,
        mine=options.mine,
        camera=options.camera,
        sensor=options.sensor,
        gripper=options.gripper,
        model=options.model,
        scale=_limits(options.scale, "scale"),
        mass=_limits(options.mass, "mass"),
        friction=_limits(options.friction, "friction"),
        things=options.things,
    )
    return generate(config, options.labels, options.workers, options.out, options.resume, options.ray)


def _add_pack(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders of labelled scenes")
    parser.add_argument("--out", type=Path, required=True, help="folder for the archive")
    parser.set_defaults(run=lambda options: pack(options.data, options.out))


def _add_unpack(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--archive", type=Path, required=True)
    parser.add_argument("--objects", required=True, help="the sets that hold its objects, joined with commas")
    parser.add_argument("--workers", type=_positive, default=1)
    parser.add_argument("--scenes", type=_positive, metavar="N", help="so many, drawn from the whole archive")
    parser.add_argument("--seed", type=int, default=0, help="of that draw")
    parser.add_argument(
        "--model", default="tesnet", choices=networks.NETWORKS, help="prepare the clouds as this network wants them"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the scenes; what is there stays")
    _add_more_views(parser)
    parser.set_defaults(run=_unpack)


def _add_camera(parser: argparse.ArgumentParser, whose: str) -> None:
    parser.add_argument(
        "--camera",
        choices=(*PRESETS, "any"),
        default="random",
        help=f"{whose}; 'any': one to four views from anywhere",
    )
    parser.add_argument("--sensor", choices=(*SENSORS, RANDOM, RANDOM_POSE), help=f"{whose}; default: the camera's own")


def _add_more_views(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--more-views",
        type=int,
        default=0,
        metavar="N",
        help="of archives, show each scene's labels from N new cameras, too",
    )
    _add_camera(parser, "of --more-views")


def _more_views(options: argparse.Namespace) -> MoreViews:
    return MoreViews(options.more_views, options.camera, options.sensor)


def _unpack(options: argparse.Namespace) -> dict[str, object]:
    return unpack(
        options.archive,
        options.objects,
        options.out,
        options.workers,
        _more_views(options),
        scenes=options.scenes,
        seed=options.seed,
        preparation=_preparation_of(options.model),
    )


def _preparation_of(model: str) -> PreparationConfig:
    return networks.NETWORKS[model][0].preparation


def _add_fit(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", default="tesnet", choices=networks.NETWORKS)
    parser.add_argument(
        "--data", type=Path, nargs="+", required=True, help="folders of labelled training scenes, or archives"
    )
    parser.add_argument("--objects", help="for archives: the sets that hold their objects, joined with commas")
    _add_more_views(parser)
    parser.add_argument(
        "--validation", type=Path, nargs="+", required=True, help="folders of labelled validation scenes"
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        nargs="+",
        default=(),
        help="folders of labelled scenes that fit the calibration of the served score; default: those of --validation",
    )
    parser.add_argument(
        "--leave-out",
        type=_fold,
        metavar="K/N",
        help="of scenes whose numbers go round N folds, do not train on fold K, 0 to N - 1; for `second-look "
        "--scored-by`, whose archive --data must be, or rendered from it",
    )
    parser.add_argument("--preset", default="default", choices=sorted(RECIPES))
    parser.add_argument("--start", type=Path, metavar="WEIGHTS", help="begin with these instead of random weights")
    parser.add_argument("--epochs", type=_positive, help="stop after so many, whatever the schedule")
    parser.add_argument("--threads", type=_positive, default=2)
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--version", default="0", help="version that the weights' header carries")
    parser.add_argument("--out", type=Path, required=True, help="weights file; its checkpoint lies beside it")
    parser.set_defaults(run=_fit)


def _fit(options: argparse.Namespace) -> dict[str, object]:
    data = [_rendered(folder, options) if is_archive(folder) else folder for folder in options.data]
    return fit(
        options.model,
        data,
        options.validation,
        RECIPES[options.preset],
        options.out,
        epochs=options.epochs,
        threads=options.threads,
        seed=options.seed,
        version=options.version,
        start=options.start,
        calibration=options.calibration,
        device=options.device,
        leave_out=options.leave_out,
    )


def _rendered(archive: Path, options: argparse.Namespace) -> Path:
    """The scenes of an archive, rendered into a folder beside the weights unless they are there."""
    if options.objects is None:
        raise LabelsError(f"{archive} is an archive, whose clouds are rendered again; name its objects with --objects")
    folder: Path = options.out.parent / f"{archive.name}-rendered"
    preparation = _preparation_of(options.model)
    unpack(archive, options.objects, folder, options.threads, _more_views(options), preparation=preparation)
    return folder


def _add_mean(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, nargs="+", required=True, help="files of one network")
    parser.add_argument(
        "--validation", type=Path, nargs="+", required=True, help="folders of labelled validation scenes"
    )
    parser.add_argument("--preset", choices=sorted(RECIPES), help="whose settings of the network it gets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--version", default="0", help="version that the weights' header carries")
    parser.add_argument("--out", type=Path, required=True)
    parser.set_defaults(run=_mean)


def _mean(options: argparse.Namespace) -> dict[str, object]:
    settings = RECIPES[options.preset].network if options.preset else {}
    return mean(
        options.weights, options.validation, options.out,
        settings=settings, seed=options.seed, version=options.version,
    )  # fmt: skip


def _add_centring(parser: argparse.ArgumentParser) -> None:
    _add_of_scenes(parser, CENTRING_EPOCHS)
    parser.set_defaults(run=_centring)


def _centring(options: argparse.Namespace) -> dict[str, object]:
    return learn_centring(
        options.archive, options.objects, options.samples, options.out,
        scenes=options.scenes, workers=options.workers, epochs=options.epochs, seed=options.seed,
        version=options.version,
    )  # fmt: skip


def _add_second_look(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, required=True, help="of the network that looks first")
    parser.add_argument(
        "--scored-by",
        type=Path,
        nargs="+",
        default=(),
        metavar="WEIGHTS",
        help="of those that `fit --leave-out 0/N`, `1/N` ... made, in this order; default: those of --weights",
    )
    _add_of_scenes(parser, SECOND_LOOK_EPOCHS)
    parser.set_defaults(run=_second_look)


def _second_look(options: argparse.Namespace) -> dict[str, object]:
    return learn_second_look(
        options.weights, options.archive, options.objects, options.samples, options.out,
        scored_by=options.scored_by, scenes=options.scenes, workers=options.workers, epochs=options.epochs,
        seed=options.seed, version=options.version,
    )  # fmt: skip


def _add_of_scenes(parser: argparse.ArgumentParser, epochs: int) -> None:
    """What is asked where samples are drawn from an archive's scenes and something is fitted to them."""
    parser.add_argument("--archive", type=Path, required=True)
    parser.add_argument("--objects", required=True, help="the sets that hold its objects, joined with commas")
    parser.add_argument("--scenes", type=_positive, metavar="N", help="so many, drawn from the whole archive")
    parser.add_argument("--workers", type=_positive, default=1)
    parser.add_argument("--samples", type=Path, required=True, help="folder for what is drawn; what is there stays")
    parser.add_argument("--epochs", type=_positive, default=epochs)
    parser.add_argument("--seed", type=int, default=0, help="of the draw and of the fit")
    parser.add_argument("--version", default="0", help="version that the weights' header carries")
    parser.add_argument("--out", type=Path, required=True)


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", default="tesnet")
    parser.add_argument("--weights", type=Path, help="default: the weights shipped for the model")
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> dict[str, object]:
    return evaluate(options.model, options.weights, options.data, options.seed)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, required=True, help="folder of weights that `fit` wrote, with their logs")
    parser.add_argument("--out", type=Path, required=True, help="folder for table1 and figure6")
    parser.add_argument(
        "--validation", type=Path, nargs="+", default=[], help="their labels; adds heuristic and shipped weights"
    )
    parser.set_defaults(run=lambda options: compare(options.data, options.out, options.validation))


if __name__ == "__main__":
    sys.exit(main())
