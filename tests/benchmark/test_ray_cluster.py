"""Items on a real Ray cluster of two nodes on this machine, one of which is lost on the way."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.benchmark.aggregation import aggregate_results, write_aggregation
from robo_manip_baselines.benchmark.plan import Plan
from robo_manip_baselines.benchmark.ray_cluster import RayExecutor
from robo_manip_baselines.benchmark.scheduler import GridProgress, WorkResult, run_items
from robo_manip_baselines.benchmark.work_item import ArtifactStore
from robo_manip_baselines.runs.errors import RequestError

from .conftest import contents

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")

pytestmark = [
    pytest.mark.slow,
    # Of Ray's own: files and sockets that it leaves to the garbage collector, and its notices.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning:ray"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
]


@pytest.fixture
def cluster(stub: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head that runs nothing but what fits into one CPU; nodes are added by the test."""
    monkeypatch.setenv("STUB_PAUSE", "0.3")  # for the work of the nodes, started from here
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from ray.cluster_utils import Cluster

        started = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 1, "object_store_memory": 80_000_000},
        )
        yield started
        ray.shutdown()
        started.shutdown()


class Watched(RayExecutor):
    """Loses a node when every CPU of the cluster is in the middle of a training."""

    def __init__(self, store: ArtifactStore, address: str, cluster: Any, node: Any) -> None:
        super().__init__(store, address)
        self.cluster, self.node, self.lost = cluster, node, False

    def wait(self) -> list[WorkResult]:
        ended = list(super().wait())
        kinds = {item.kind for item in self._running.values()}
        if not self.lost and kinds == {"training"} and not ray.available_resources().get("CPU"):
            self.cluster.remove_node(self.node, allow_graceful=False)
            self.lost = True
        return ended


def test_a_node_lost_in_the_middle_changes_nothing(
    stub_plan: Plan, reference: dict[str, bytes], cluster: Any, tmp_path: Path
) -> None:
    node = cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    cluster.wait_for_nodes()
    store, items = ArtifactStore(tmp_path / "items"), stub_plan.items()
    with closing(Watched(store, cluster.address, cluster, node)) as executor:
        run_items(items, store, executor, GridProgress(items, 2, bar=False))
        assert executor.lost
    statistics = aggregate_results(stub_plan, store, tmp_path)
    write_aggregation(stub_plan, store, statistics, tmp_path, {}, "the command")
    assert contents(tmp_path) == reference
    assert all(store.is_done(item) for item in items)


def test_a_unit_that_no_node_can_run_is_refused(
    stub_plan: Plan, cluster: Any, tmp_path: Path
) -> None:
    large = replace(stub_plan.items()[0], gpus=1.0)
    with (
        closing(RayExecutor(ArtifactStore(tmp_path), cluster.address)) as executor,
        pytest.raises(RequestError, match="wants 1 CPUs and 1 GPUs"),
    ):
        executor.has_room(large)


def test_no_cluster_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="ray start --head"):
        RayExecutor(ArtifactStore(tmp_path), "127.0.0.1:1")
