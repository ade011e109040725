"""Take a record that somebody else made onto the board, if it is what it says."""

from collections.abc import Sequence
from pathlib import Path

from m3gn_bench.checkpoint import is_of_preset
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.datasets.schema import IMPORTED, Record
from m3gn_bench.errors import ConfigError
from m3gn_bench.leaderboard.consistency import contradictions
from m3gn_bench.leaderboard.record import RECORD_SCHEMA, ResultRecord, checkpoint_folder, find_record
from m3gn_bench.leaderboard.summary import entries
from m3gn_bench.model import model_names
from m3gn_bench.version import __version__

LONG = 1.5  # times as long as all others of a board; machines differ, too
LARGE = 2.0  # times as large as all others of a board, which are of one preset


class Verdict(Record):
    """What is wrong with a submission, and what its readers should know."""

    problems: tuple[str, ...]
    remarks: tuple[str, ...]


def review(record: ResultRecord, board: Sequence[ResultRecord], replace: bool = False) -> Verdict:
    """Compare a submission with what is on the board; its statistics were derived again when it was read.

    Args:
        record: the submission.
        board: all records there are.
        replace: whether it may take the place of the record of that name.
    """
    problems, remarks = [], _new_track(record, board)
    if replace:
        taken = find_record(board, record.track, record.task, record.name)
        if taken is not None and taken.ships:
            problems.append(_without_checkpoint(taken))
        board = [peer for peer in board if peer is not taken]
    if record.record_schema != RECORD_SCHEMA:
        problems.append(
            f"record_schema is {record.record_schema}, not {RECORD_SCHEMA}: make it with this version"
        )
    if record.dataset_version.startswith(IMPORTED):
        problems.append("it was scored on imported data, but boards are of the benchmark's own")
        return Verdict(problems=tuple(problems), remarks=())
    on_same_split = any((peer.track, peer.split) == (record.track, record.split) for peer in board)
    if record.split != "test" and not on_same_split:  # tracks of trials are of the validation split
        problems.append(f"split is {record.split!r}, but boards are of the test split")
    if find_record(board, record.track, record.task, record.name) is not None:
        problems.append(
            f"there is a record of {record.task}/{record.name} already; give --replace to replace it"
        )
    if record.materials and not record.variant:
        problems.append("it is of some materials only; name them by a variant")
    problems += contradictions(record)
    if record.model not in model_names():
        remarks.append(
            f"{record.model} is not installed here: whether its settings are those of preset {record.preset!r}, and "
            "how many parameters that makes, was not checked"
        )
    elif not problems and not record.variant and not _is_of_preset(record):
        problems.append(
            f"its settings are not those of preset {record.preset!r}; name what differs by a variant"
        )
    if record.package_version != __version__:
        remarks.append(f"it was made with version {record.package_version}, not {__version__}")

    for what, made_by in (("trained", record.checkpoint.commit), ("scored", record.commit)):
        if made_by is not None and made_by.endswith("+changes"):
            remarks.append(f"it was {what} by code with changes that no commit holds ({made_by})")

    problems += _unequal_conditions(record, board) + _copied(record, board)
    remarks += _fair_budget(record, board) + _large(record, board)
    of_data = _compared_data(record, board)
    problems += of_data.problems
    remarks += of_data.remarks
    if not problems:
        problems += _without_a_place(record, board)
    return Verdict(problems=tuple(problems), remarks=tuple(remarks))


def _compared_data(record: ResultRecord, board: Sequence[ResultRecord]) -> Verdict:
    """What the records of the same trajectories say of the submission's."""
    peers = [
        peer
        for peer in board
        if (peer.task, peer.tier, peer.split, peer.materials)
        == (record.task, record.tier, record.split, record.materials)
    ]
    if not peers:
        unknown = "nothing on the board was scored on such trajectories: the data were not compared"
        return Verdict(problems=(), remarks=(unknown,))
    problems, remarks = [], []
    trained_on = {peer.checkpoint.dataset_hash for peer in peers}
    if record.checkpoint.dataset_hash not in trained_on:
        remarks.append(
            "nothing on the board was trained on the same bits; it may be another kind of processor, or other data"
        )
    peer = peers[0]
    if record.keys != peer.keys:
        problems.append(f"it has other trajectories than {peer.task}/{peer.name}, or another order of them")
    else:
        pairs = zip(record.trajectory_hashes, peer.trajectory_hashes, strict=True)
        different = sum(own != theirs for own, theirs in pairs)
        if not different and record.dataset_hash not in {peer.dataset_hash for peer in peers}:
            problems.append("dataset_hash is that of other trajectories than trajectory_hashes say")
        if different:
            remarks.append(
                f"{different} of {len(record.keys)} trajectories differ in some bit from those on record; on another "
                "kind of processor they may ('m3gn-bench reproduce' tells whether by more than rounding)"
            )
    return Verdict(problems=tuple(problems), remarks=tuple(remarks))


def _is_of_preset(record: ResultRecord) -> bool:
    try:
        return is_of_preset(record.checkpoint)
    except ConfigError:  # no such preset
        return False


def _without_checkpoint(taken: ResultRecord) -> str:
    folder = checkpoint_folder(taken.task, taken.model, taken.preset, taken.seed, Path())
    return (
        f"{taken.task}/{taken.name} ships with its checkpoint, which would be left without its record: put the new one "
        f"into {folder} of the leaderboard, and score it there with 'm3gn-bench evaluate --record --replace'"
    )


def _new_track(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    tracks = sorted({peer.track for peer in board})
    if record.track in tracks:
        return []
    return [
        f"there is no track {record.track!r} yet, so a new board begins with it; known: {', '.join(tracks) or 'none'}"
    ]


def _copied(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """Whose weights or errors it has, though training with another seed or of another model never ends in the same.

    One checkpoint may be on several tracks, and there its model may have another name: what an ablation changes is part
    of some presets.
    """
    if not record.checkpoint.steps:  # what does not learn is the same for every seed
        return []
    errors = [result.trajectory_mse for result in record.results]
    for peer in board:
        is_another = peer.seed != record.seed or (peer.track == record.track and peer.name != record.name)
        if peer.task != record.task or not is_another:
            continue
        of_peer = f"those of {peer.name} in track {peer.track!r}: train it with a seed of its own"
        if peer.checkpoint.weights_sha256 == record.checkpoint.weights_sha256:
            return [f"its weights are {of_peer}"]
        if [result.trajectory_mse for result in peer.results] == errors:
            return [f"its errors are, to the last digit, {of_peer}"]
    return []


def _large(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    beside = [peer for peer in board if (peer.track, peer.task) == (record.track, record.task)]
    most = max((peer.parameters for peer in beside), default=0)
    if not most or record.parameters <= LARGE * most:
        return []
    return [
        f"it has {record.parameters} parameters, the others of its board {most} at most: is that the size of preset "
        f"{record.preset!r}?"
    ]


def _fair_budget(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """What to ask of its minutes and steps: only the budget of a model that the board has is compared as such."""
    own = record.checkpoint
    beside = [
        peer
        for peer in board
        if (peer.track, peer.task) == (record.track, record.task) and peer.checkpoint.steps
    ]
    if not own.steps or not beside:
        return []
    remarks = []
    longest = max((p.checkpoint.minutes for p in beside if _device(p) == _device(record)), default=None)
    most = max(peer.checkpoint.steps for peer in beside)
    if longest is not None and own.minutes > LONG * longest:
        remarks.append(
            f"it was trained for {own.minutes:.3g} minutes of {_device(record)}, the others of its board for "
            f"{longest:.3g} at most: is its machine so much slower?"
        )
    if own.steps > LONG * most:
        remarks.append(
            f"it was trained for {own.steps} steps, the others of its board for {most} at most: are its steps so much "
            "cheaper?"
        )
    if not any((peer.model, peer.preset) == (record.model, record.preset) for peer in beside):
        of_m3gn = [peer.checkpoint.steps for peer in beside if peer.model == "m3gn"]
        usual = f"{max(of_m3gn)} of m3gn" if of_m3gn else f"{most} at most of others"
        remarks.append(
            f"its board has no other {record.model}: are {own.steps} steps a fair budget beside the {usual}?"
        )
    return remarks


def _device(record: ResultRecord) -> str:
    """The kind of device that trained it, whichever of several that was."""
    return record.checkpoint.device.partition(":")[0]


def _without_a_place(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """Why its board cannot be made with it."""
    try:
        entries([*board, record], record.track, record.task)
    except BenchError as error:
        return [f"the board cannot be made with it: {error}"]
    return []


def _unequal_conditions(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """In what a submission differs from the records that it would stand beside, where all must be equal."""

    def conditions(of: ResultRecord) -> dict[str, object]:
        trained = of.checkpoint
        where = {"device": trained.device, "threads": trained.threads, "processes": trained.processes}
        by_the_clock = trained.config.training.get("minutes") is not None  # steps are the same anywhere
        return {"tier": of.tier, "split": of.split, "preset": of.preset} | (where if by_the_clock else {})

    def budget(of: ResultRecord) -> dict[str, object]:
        return {name: of.checkpoint.config.training.get(name) for name in ("minutes", "steps")}

    beside = [peer for peer in board if (peer.track, peer.task) == (record.track, record.task)]
    own = conditions(record)
    problems = []
    for name, value in own.items():
        theirs = {conditions(peer)[name] for peer in beside if name in conditions(peer)}
        if theirs and value not in theirs:
            problems.append(
                f"{name} is {value}, but {', '.join(map(str, theirs))} for all others of track {record.track!r}"
            )
    for peer in beside:
        if (peer.model, peer.preset) != (record.model, record.preset):
            continue
        same = peer.checkpoint.config_hash, peer.materials
        if peer.variant == record.variant and same != (record.checkpoint.config_hash, record.materials):
            problems.append(f"its settings are not those of {peer.name}; name what differs by a variant")
            break
        if budget(peer) != budget(record):
            problems.append(f"its budget is {budget(record)}, but {budget(peer)} for {peer.name}")
            break
    return problems
