"""Take a record that somebody else made onto the board, if it is what it says."""

from collections.abc import Sequence

from m3gn_bench.datasets.schema import IMPORTED, Record
from m3gn_bench.errors import ConfigError
from m3gn_bench.leaderboard.consistency import contradictions
from m3gn_bench.leaderboard.record import RECORD_SCHEMA, ResultRecord, find_record
from m3gn_bench.model import load_preset, model_names
from m3gn_bench.tasks import get_task
from m3gn_bench.version import __version__

LONG = 1.5  # times as long as all others of a board; machines differ, too


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
    problems, remarks = [], []
    if replace:
        taken = find_record(board, record.track, record.task, record.name)
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
        remarks.append(f"{record.model} is not installed here: its settings and parameters were not checked")
    elif not problems and not record.variant and not _is_of_preset(record):
        problems.append(
            f"its settings are not those of preset {record.preset!r}; name what differs by a variant"
        )
    if record.package_version != __version__:
        remarks.append(f"it was made with version {record.package_version}, not {__version__}")

    for what, made_by in (("trained", record.checkpoint.commit), ("scored", record.commit)):
        if made_by is not None and made_by.endswith("+changes"):
            remarks.append(f"it was {what} by code with changes that no commit holds ({made_by})")

    problems += _unequal_conditions(record, board)
    remarks += _long_training(record, board)
    peers = [
        peer
        for peer in board
        if (peer.task, peer.tier, peer.split, peer.materials)
        == (record.task, record.tier, record.split, record.materials)
    ]
    if not peers:
        remarks.append("nothing on the board was scored on such trajectories: the data were not compared")
        return Verdict(problems=tuple(problems), remarks=tuple(remarks))
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
        usual = load_preset(record.model, record.preset, get_task(record.task))
    except ConfigError:  # no such preset
        return False
    return record.checkpoint.config_hash == usual.hash()


def _long_training(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """What to ask of its minutes and steps: only the budget of a model that the board has is compared as such."""
    own = record.checkpoint
    others = [
        peer.checkpoint
        for peer in board
        if (peer.track, peer.task) == (record.track, record.task) and peer.checkpoint.steps
    ]
    if not own.steps or not others:
        return []
    remarks = []
    longest, most = (max(getattr(peer, what) for peer in others) for what in ("minutes", "steps"))
    if own.minutes > LONG * longest:
        remarks.append(
            f"it was trained for {own.minutes:.3g} minutes, the others of its board for {longest:.3g} at most: is its "
            "machine so much slower?"
        )
    if own.steps > LONG * most:
        remarks.append(
            f"it was trained for {own.steps} steps, the others of its board for {most} at most: are its steps so much "
            "cheaper?"
        )
    elif own.device not in {peer.device for peer in others}:
        remarks.append(
            f"it was trained on {own.device}, so its minutes say nothing: are {own.steps} steps a fair budget?"
        )
    return remarks


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
