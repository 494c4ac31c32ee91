"""`python -m benchmarks.page_load HOME`: the page of cases under load, a thousand requests by twenty threads, twice.

Prints how often each status was answered, the median and the 95th of a hundred of the times, and what the server's
process holds before and after the second thousand. A tenth come without a session. HOME should be a copy: lines are
written into its log of cases.
"""

import re
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np

REQUESTS, THREADS = 1_000, 20


def memory_mb(pid: int) -> float:
    """What a process holds in memory. [MB]"""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024


def load(address: str, cookies: httpx.Cookies, cases: list[str]) -> tuple[Counter[int], np.ndarray]:
    """Statuses and times [s] of one round."""
    signed_in, stranger = httpx.Client(base_url=address, cookies=cookies), httpx.Client(base_url=address)
    watch = {"data": {"kind": "watch", "seen": "0"}, "headers": {"origin": address}}

    def ask(n: int) -> tuple[int, float]:
        case, start = cases[n % len(cases)], time.perf_counter()
        if n % 10 == 0:
            answer = stranger.get(f"/?token=guess-{n}")
        elif n % 100 == 1:
            answer = signed_in.post(case, **watch)
        else:
            answer = signed_in.get(("/", "/?all", case)[n % 3])
        return answer.status_code, time.perf_counter() - start

    with signed_in, stranger, ThreadPoolExecutor(THREADS) as pool:
        answers = list(pool.map(ask, range(REQUESTS)))
    return Counter(status for status, _ in answers), np.array([took for _, took in answers])


def main(home: str) -> None:
    """Serve the home on a free port and load it twice."""
    command = [Path(sys.executable).with_name("hdt"), "serve", "--home", home, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address, token = re.search(r"(http://\S+)/\?token=(\S+)", server.stdout.readline()).groups()
            with httpx.Client(base_url=address, timeout=60) as browser:
                browser.get("/", params={"token": token})
                cases = re.findall(r'href="(/case/[^"]+)"', browser.get("/?all").text)
                for name in ("first", "second"):
                    before = memory_mb(server.pid)
                    statuses, took = load(address, browser.cookies, cases)
                    after_mb, (half, most) = memory_mb(server.pid), np.quantile(took, (0.5, 0.95))
                    times = f"median {half:.3f} s, 95 % {most:.3f} s"
                    print(f"{name}: {dict(statuses)}, {times}, {before:.1f} MB before, {after_mb:.1f} MB after")
        finally:
            server.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
