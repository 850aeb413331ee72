"""Run a function of a test file in several processes of torch.distributed (gloo)."""

import json
import subprocess
import sys

from subprocesses import subprocess_environment
from waiting import PATIENCE

WORKER = """
import importlib.util, json, sys
import torch.distributed as dist
path, name, rendezvous, rank, ranks = sys.argv[1:]
spec = importlib.util.spec_from_file_location("body", path)
body = importlib.util.module_from_spec(spec)
spec.loader.exec_module(body)
dist.init_process_group("gloo", init_method="file://" + rendezvous, rank=int(rank), world_size=int(ranks))
answer = getattr(body, name)(int(rank))
dist.destroy_process_group()
print(json.dumps(answer))
"""


def on_ranks(path, name, folder, ranks=2):
    """Return what ``name(rank)`` of the file returns, by rank; it must go through JSON."""
    processes = []
    for rank in range(ranks):
        command = [sys.executable, "-c", WORKER, str(path), name, str(folder / name), str(rank), str(ranks)]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, env=subprocess_environment()))
    outputs = [process.communicate(timeout=PATIENCE)[0] for process in processes]
    assert all(process.returncode == 0 for process in processes)
    return [json.loads(output.splitlines()[-1]) for output in outputs]
