"""The store: results that stay, claims that end with their owner, and files that are somebody else's."""

from __future__ import annotations

import json
import multiprocessing
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import pytest

from client.errors import OutputError
from client.quality import Quality
from server.asked import AskedSweep
from server.points import Point, PointResult
from server.reading import StoreReader
from server.store import SCHEMA_VERSION, Store
from tests.sweeping import some_latency


def result(number: int, text: str = "") -> PointResult:
    point = Point("clip", f"{number}", 64, 48, 30, None, 24, None, 200, {"threads": 1}, "bicubic", "b", {"av": text})
    return PointResult(point, 201.5, (), Quality(3, psnr_y_db=30.25, undefined={"vmaf": "none"}), None, "none")


def test_what_is_kept_is_there_for_the_next_and_the_first_of_two_stays(tmp_path: Path) -> None:
    with Store(tmp_path / "store") as store:
        store.keep_point(result(1))
        store.keep_point(replace(result(1), bitrate_kbps=0.0))
        store.keep_latency("key", some_latency())
    with Store(tmp_path / "store") as store:
        assert store.point(result(1).point.key) == result(1) and store.point("other") is None
        assert store.latency("key") == some_latency() and store.latency("other") is None
        with sqlite3.connect(tmp_path / "store") as connection:
            assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
            assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)


@pytest.mark.parametrize(
    "damage",
    [
        '{"',
        "[]",
        "{}",
        "[" * 100_000,
        *(
            json.dumps({**result(1).record(), **change})
            for change in ({"more": 1}, {"flags": ["SIDEWAYS"]}, {"bitrate_kbps": float("nan")}, {"bitrate_kbps": "fast"}, {"point": {}})
        ),
        json.dumps(result(1).record()).replace("201.5", "1e999"),
        json.dumps(result(1).record()).replace('"vmaf": "none"', '"vmaf": 0'),
    ],
    ids=range(11),
)
def test_a_record_that_no_sweep_has_written_is_one_sentence_with_the_stores_name(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "store"
    point, asked = result(1).point, AskedSweep.of([result(1).point], ["key"])
    with Store(path) as store:
        store.keep_point(result(1))
        store.keep_latency("key", some_latency())
        store.keep_sweep(asked)
        reader = StoreReader(path)
        for table in ("points", "latencies", "sweeps"):
            store._connection.execute(f"UPDATE {table} SET record = ?", (damage,))
        for read in (
            lambda: store.point(point.key),
            lambda: store.latency("key"),
            lambda: reader.points(asked),
            lambda: reader.latencies(asked),
            reader.all_latencies,
            reader.sweeps,
            lambda: reader.sweep(asked.key),
        ):
            with pytest.raises(OutputError, match="holds a record that is damaged") as caught:
                read()
            assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_same_question_under_other_names_is_another_sweep(tmp_path: Path) -> None:
    """As when two files have changed their names with each other."""
    points = [replace(result(number).point, clip=name) for number, name in ((1, "a"), (2, "b"))]
    swapped = [replace(result(number).point, clip=name) for number, name in ((1, "b"), (2, "a"))]
    model = [replace(point, upscaler="mine") for point in points]
    asked = [AskedSweep.of(each, ["key"]) for each in (points, swapped, model, points[::-1])]
    with Store(tmp_path / "store") as store:
        for sweep in asked:
            store.keep_sweep(sweep)
    kept = StoreReader(tmp_path / "store").sweeps()
    assert set(kept) == {sweep.key for sweep in asked[:3]} and asked[3].key == asked[0].key
    assert [clip.name for clip in kept[asked[1].key].asked.clips] == ["b", "a"]


def test_a_sweep_that_was_kept_under_its_keys_alone_is_still_read(tmp_path: Path) -> None:
    asked = AskedSweep.of([result(1).point], ["key"])
    with Store(tmp_path / "store") as store:
        store.keep_sweep(asked)
        store._connection.execute("UPDATE sweeps SET key = 'as it was made before'")
        assert list(StoreReader(tmp_path / "store").sweeps()) == ["as it was made before"]


def test_all_of_many_sweeps_that_begin_at_once_open_one_new_store(tmp_path: Path) -> None:
    together = Barrier(8)

    def open_new(attempt: int) -> int | None:
        together.wait()
        with Store(tmp_path / f"store{attempt}") as store:
            return store._version()

    with ThreadPoolExecutor(together.parties) as sweeps:
        for attempt in range(10):
            assert set(sweeps.map(open_new, [attempt] * together.parties)) == {SCHEMA_VERSION}


def test_a_claim_is_one_sweeps_until_it_is_given_back_or_its_sweep_is_gone(tmp_path: Path) -> None:
    with Store(tmp_path / "store") as one:
        with Store(tmp_path / "store") as two:
            assert one.claim(["a", "b"]) == ["a", "b"]
            assert two.claim(["a", "b", "c"]) == ["c"] and two.claim(["c"]) == []
            two.release("a")  # not its own
            one.release("b")
            assert two.claim(["a", "b"]) == ["b"]
        assert one.claim(["b", "c"]) == ["b", "c"]


def test_a_stored_point_is_claimed_by_nobody(tmp_path: Path) -> None:
    with Store(tmp_path / "store") as one, Store(tmp_path / "store") as two:
        key = result(1).point.key
        assert one.claim([key]) == [key]
        one.keep_point(result(1))
        assert one.claim([key]) == two.claim([key]) == []


def test_alone_means_that_nobody_computes_and_nobody_begins(tmp_path: Path) -> None:
    with Store(tmp_path / "store") as one, Store(tmp_path / "store") as two:
        one.claim(["a"])
        assert not two.claim_alone()
        one.release("a")
        assert two.claim_alone() and not one.claim_alone() and one.claim(["a"]) == []
        two.release_alone()
        assert one.claim(["a"]) == ["a"]


def test_a_lease_is_renewed_while_its_sweep_lives_and_runs_out_when_it_is_killed(tmp_path: Path) -> None:
    with Store(tmp_path / "store", lease_s=1.0) as one, Store(tmp_path / "store") as two:
        one.claim(["a"])
        time.sleep(1.5)
        assert two.claim(["a"]) == []
        one._closing.set()  # what a kill does to the thread
        one._heartbeat.join()
        time.sleep(1.1)
        assert two.claim(["a"]) == ["a"]


def open_and_claim(path: Path) -> None:
    with Store(path) as store:
        for number in range(30):
            for key in store.claim([str(number)]):
                store.keep_point(result(int(key)))


def test_many_may_create_and_fill_it_at_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=open_and_claim, args=(tmp_path / "store",)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    with Store(tmp_path / "store") as store:
        assert all(store.point(result(number).point.key) for number in range(30))


def test_another_schema_version_another_database_and_no_database_are_refused_untouched(tmp_path: Path) -> None:
    newer, other, text = (tmp_path / name for name in ("newer", "other", "text"))
    Store(newer).__exit__(None, None, None)
    for path, statement in ((newer, f"PRAGMA user_version = {SCHEMA_VERSION + 1}"), (other, "CREATE TABLE mine (x)")):
        with sqlite3.connect(path) as connection:
            connection.execute(statement)
    text.write_text("no database" * 500)
    for path, sentence in ((newer, "schema version 2, not 1"), (other, "not of gamesr-sweep"), (text, "not a database")):
        before = path.read_bytes()
        with pytest.raises(OutputError, match=sentence) as caught:
            Store(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value) and path.read_bytes() == before
    with pytest.raises(OutputError, match="unable to open"):
        Store(tmp_path / "no folder" / "store")


def test_no_space_left_is_one_sentence_and_what_was_kept_stays(tmp_path: Path) -> None:
    with Store(tmp_path / "store") as store:
        (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
        store._connection.execute(f"PRAGMA max_page_count = {pages + 8}")
        kept = 0
        with pytest.raises(OutputError, match="full"):
            for kept in range(1000):
                store.keep_point(result(kept, "x" * 1000))
    with Store(tmp_path / "store") as store:
        assert kept > 2 and [store.point(result(n, "x" * 1000).point.key) is not None for n in range(kept + 1)] == [True] * kept + [False]
