"""Bags by URL: read in ranges, the same messages as from this machine, and damage found where it is read."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import s3fs
from werkzeug.serving import make_server

from magnetosuture_thread import cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import RANGE_BYTES, open_file
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands.evaluate import evaluate_bags, find_bags
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import parse_location
from test.bags.bags import (
    IMAGE,
    SECOND,
    STRING,
    cdr,
    chunks_of,
    make,
    read,
    stamped,
    texts,
    write_many_chunks,
    write_mcap,
)
from test.evaluation.runs import TIMES

PICTURE_BYTES = 300_000


class CountingServer:
    """An S3 server of this machine, which counts what it serves.

    Attributes:
        served: bytes of the body of each answer with a part or the whole of an object, by the object's key.
        whole: keys of objects that were asked for without a range.
    """

    def __init__(self) -> None:
        # Here, as it takes seconds to import, and every worker imports this module.
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app

        self._app = DomainDispatcherApplication(create_backend_app)
        self.served: dict[str, list[int]] = {}
        self.whole: set[str] = set()

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        """Answer a request, as WSGI has it."""
        key = environ["PATH_INFO"]
        body = b"".join(self._app(environ, start_response))
        if environ["REQUEST_METHOD"] == "GET" and key.count("/") > 1 and not environ["QUERY_STRING"]:
            self.served.setdefault(key, []).append(len(body))
            if "HTTP_RANGE" not in environ:
                self.whole.add(key)
        return [body]


@pytest.fixture(scope="module")
def s3() -> Iterator[CountingServer]:
    """Return a server with an empty bucket `lab`, which URLs of S3 lead to."""
    app = CountingServer()
    server = make_server("127.0.0.1", 0, app, threaded=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_DEFAULT_REGION"):
            patch.setenv(name, "us-east-1")
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("lab")
        yield app
        s3fs.S3FileSystem.clear_instance_cache()
    server.shutdown()
    thread.join()


def upload(local: Path, url: str) -> Path:
    """Copy a file or folder to a URL, and return it as a place."""
    filesystem, target = fsspec.core.url_to_fs(url)
    filesystem.put(str(local), target, recursive=True)
    return parse_location(url)


def in_memory(data: bytes, name: str) -> Path:
    """Return the place of a file in memory."""
    fsspec.filesystem("memory").pipe(f"/{name}", data)
    return parse_location(f"memory://{name}")


@pytest.fixture(scope="module")
def long_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a bag of 12 MB in forty chunks."""
    noise = np.random.default_rng(5)
    folder = tmp_path_factory.mktemp("bags") / "long"
    with BagWriter(folder, {"setup": "example"}) as bag:
        bag.add_topic("/camera", IMAGE)
        bag.add_topic("/text", STRING)
        for index in range(40):
            at = SECOND * (1 + 3 * index)
            picture = noise.integers(0, 256, PICTURE_BYTES, dtype=np.uint8)
            bag.write_message("/camera", at, make(IMAGE, stamped(index), "jpeg", picture))
            if index == 30:
                bag.write("/text", at + 20, cdr(STRING, "once"))
    return folder


def test_of_a_bag_on_s3_only_what_is_read_is_fetched(s3: CountingServer, long_bag: Path):
    place = upload(long_bag, "s3://lab/runs/long")
    local, (file,) = Bag(long_bag), long_bag.glob("*.mcap")
    key, size = f"/lab/runs/long/{file.name}", file.stat().st_size
    far = Bag(place)
    assert (far.topics, far.counts, far.notes) == (local.topics, local.counts, local.notes)
    assert (far.start, far.end, far.damage, far.has_no_checksum) == (local.start, local.end, None, "")
    opened = sum(s3.served[key])
    assert opened <= 2 * RANGE_BYTES < size / 4
    (record,) = far.records({"/text"})
    assert record.decode().data == "once"
    one_chunk = sum(s3.served[key]) - opened
    assert one_chunk <= 2 * RANGE_BYTES
    some = [record.time for record in far.records(start=9.0, duration=12.0)]
    assert some == [record.time for record in local.records(start=9.0, duration=12.0)]
    assert sum(s3.served[key]) < 0.7 * size
    assert read(far) == read(local)
    assert sum(s3.served[key]) < 2 * size
    assert key not in s3.whole


def test_a_bag_on_s3_is_found_and_evaluated_as_one_of_this_machine(s3: CountingServer, short_bag: Path, tmp_path: Path):
    upload(short_bag, "s3://lab/fleet/pull")
    (place,) = find_bags([parse_location("s3://lab/fleet")])
    assert str(place) == "s3://lab/fleet/pull"
    (far,), (here,) = (evaluate_bags([bag], tmp_path / f"out{n}") for n, bag in enumerate([place, short_bag]))
    other = dict.fromkeys((*TIMES, "path"))
    assert {**far, **other} == {**here, **other}
    assert far["path"] == "s3://lab/fleet/pull"


def test_an_absent_url_gives_one_line(s3: CountingServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = ["--output", str(tmp_path / "out")]
    for url in ("s3://lab/nothing", "s3://none/nothing", "memory://nothing"):
        assert cli.main(["evaluate", url, *output]) == 1
        assert "does not exist" in capsys.readouterr().err
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
        patch.setenv("AWS_MAX_ATTEMPTS", "1")
        s3fs.S3FileSystem.clear_instance_cache()
        assert cli.main(["evaluate", "s3://lab/runs", *output]) == 1
        s3fs.S3FileSystem.clear_instance_cache()
    assert "cannot be read: Could not connect" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "nowhere://x", *output])
    assert "no URL of a known file system" in capsys.readouterr().err


def test_a_damaged_chunk_is_an_error_where_it_is_read_and_not_before(tmp_path: Path):
    path = write_many_chunks(tmp_path / "bag")
    data = bytearray(path.read_bytes())
    start, end, _ = list(chunks_of(path))[20]
    data[(start + end) // 2] ^= 0xFF
    bag = Bag(in_memory(bytes(data), "damaged.mcap"))
    assert bag.damage is None
    messages: list[int] = []
    with pytest.raises(BagError, match=r"has a chunk .* at byte \d+; `bag check` of a copy tells what is intact"):
        messages.extend(record.time for record in bag.records())
    before = [time for _, _, inside in list(chunks_of(path))[:20] for _, time, _ in inside]
    assert messages == sorted(before)


def test_a_file_of_a_bag_that_cannot_be_fetched_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(2):
        write_mcap(folder / f"run_{number}.mcap", texts(3), {"/text": STRING})
        in_memory((folder / f"run_{number}.mcap").read_bytes(), f"run/run_{number}.mcap")

    def open_first(path: Path) -> Any:
        if path.name == "run_1.mcap":
            raise OSError(5, "Input/output error")
        return open_file(path)

    monkeypatch.setattr("magnetosuture_thread.bags.storage.open_file", open_first)
    assert "Input/output error" in str(Bag(folder).damage)
    with pytest.raises(BagError, match=r"run_1\.mcap: cannot be read: Input/output error"):
        Bag(parse_location("memory://run"))


@pytest.mark.parametrize("kind", ["truncated", "no checksums", "no chunks", "whole"])
def test_a_file_by_url_is_read_as_a_local_one(tmp_path: Path, kind: str):
    path = tmp_path / "x.mcap"
    writers: dict[str, dict[str, Any]] = {"no checksums": {"enable_crcs": False}, "no chunks": {"use_chunking": False}}
    write_mcap(path, texts(200), {"/text": STRING}, **writers.get(kind, {}))
    data = path.read_bytes()
    if kind == "truncated":
        data = data[: len(data) // 2]
        path.write_bytes(data)
    local, far = Bag(path), Bag(in_memory(data, "x.mcap"))
    assert read(far) == read(local)
    assert (far.counts, far.has_no_checksum) == (local.counts, local.has_no_checksum)
    assert str(far.damage) == str(local.damage)
    assert ("verified as they are read" in far.facts[0]["checksums"]) == (kind == "whole")
