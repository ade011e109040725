"""Take a record that somebody else made onto the board, if it is what it says."""

from collections.abc import Sequence

from m3gn_bench.datasets.schema import IMPORTED, Record
from m3gn_bench.leaderboard.consistency import contradictions
from m3gn_bench.leaderboard.record import RECORD_SCHEMA, ResultRecord, find_record
from m3gn_bench.model import model_names


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
    if find_record(board, record.track, record.task, record.name) is not None and not replace:
        problems.append(
            f"there is a record of {record.task}/{record.name} already; give --replace to replace it"
        )
    if record.materials and not record.variant:
        problems.append("it is of some materials only; name them by a variant")
    problems += contradictions(record)
    if record.model not in model_names():
        remarks.append(f"{record.model} is not installed here: its settings and parameters were not checked")

    problems += _unequal_conditions(record, board)
    peers = [
        peer
        for peer in board
        if (peer.task, peer.tier, peer.split, peer.materials)
        == (record.task, record.tier, record.split, record.materials)
    ]
    if not peers:
        remarks.append("nothing on the board was scored on such trajectories: the data were not compared")
        return Verdict(problems=tuple(problems), remarks=tuple(remarks))
    peer = peers[0]
    if record.keys != peer.keys:
        problems.append(f"it has other trajectories than {peer.task}/{peer.name}, or another order of them")
    else:
        pairs = zip(record.trajectory_hashes, peer.trajectory_hashes, strict=True)
        different = sum(own != theirs for own, theirs in pairs)
        if different:
            remarks.append(
                f"{different} of {len(record.keys)} trajectories differ in some bit from those on record; on another "
                "kind of processor they may ('m3gn-bench reproduce' tells whether by more than rounding)"
            )
    return Verdict(problems=tuple(problems), remarks=tuple(remarks))


def _unequal_conditions(record: ResultRecord, board: Sequence[ResultRecord]) -> list[str]:
    """In what a submission differs from the records that it would stand beside, where all must be equal."""

    def conditions(of: ResultRecord) -> dict[str, object]:
        trained = of.checkpoint
        where = {"device": trained.device, "threads": trained.threads, "processes": trained.processes}
        return {"tier": of.tier, "split": of.split} | (where if trained.steps else {})

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
        same_row = (peer.model, peer.preset, peer.variant) == (record.model, record.preset, record.variant)
        if not same_row:
            continue
        if peer.checkpoint.config_hash != record.checkpoint.config_hash or peer.materials != record.materials:
            problems.append(f"its settings are not those of {peer.name}; name what differs by a variant")
            break
        if budget(peer) != budget(record):
            problems.append(f"its budget is {budget(record)}, but {budget(peer)} for {peer.name}")
            break
    return problems
