"""A Ray cluster of two nodes of one core each on this machine, in a process without JAX, since Ray forks.

It prints the cluster's address and the process of the second node's raylet, kills that node at a line on its standard
input, and says so; at the end of its input it ends the cluster.
"""

import os
import sys

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112  # as Ray spells it

from ray.cluster_utils import Cluster

NODE = {"num_cpus": 1, "object_store_memory": 80_000_000, "memory": 4_000_000_000}


def main() -> None:
    cluster = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    try:
        second = cluster.add_node(**NODE)
        print(f"cluster {cluster.address} {second.all_processes['raylet'][0].process.pid}", flush=True)
        if sys.stdin.readline():
            cluster.remove_node(second, allow_graceful=False)
            print("killed", flush=True)
        sys.stdin.read()
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    main()
