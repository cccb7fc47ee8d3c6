# SPDX-License-Identifier: Apache-2.0
"""On slow networks with a round trip of 20 ms another PC's camera is as fresh as the network allows

The camera writes more images than the network carries. After opening, later, and after a cut of 20 s
the newest image on the other PC is at most about as old as the network needs to send two images.
"""

import time

from lab.guest import Guest
from lab.lab import Lab
from lab.load import Load
from lab.network import guest_address

ONLY_BY_NAME = "it takes minutes, and speed means little on guests"

CAMERA = "camera:0@pc1"
RATE_HZ = 30
IMAGE_BYTES = 640 * 480 * 3
NETWORKS_MB_PER_S = (1, 10)
ONE_WAY_MS = 10
CUT_SECONDS = 20
LINGER_SECONDS = 6  # a mirror without readers has gone; and the camera's ring is full
CONF = "/etc/dssm/dssmd.conf"
NO_CLOCKS = 'clock_streams = ["camera*=off"]'


def run(lab: Lab) -> None:
    """Measures ages on pc2 while the packets of pc1 are delayed and limited."""
    pc1, pc2 = lab["pc1"], lab["pc2"]
    # In the network's queue clocks cannot be measured well enough for the camera's reader.
    pc2.ssh.run(f"cp {CONF} {CONF}.before && echo '{NO_CLOCKS}' >>{CONF} && systemctl reload dssmd")
    camera = Load(pc1, "film", [CAMERA], RATE_HZ).await_ready()
    for rate in NETWORKS_MB_PER_S:
        time.sleep(LINGER_SECONDS)
        shape(pc1, 2, rate)
        shape(pc2, 1, 1000)
        try:
            measure(lab, rate)
        finally:
            for guest in (pc1, pc2):
                guest.ssh.run("tc qdisc del dev vec0 root")
    camera.finish()
    pc1.ssh.run(f"dssmctl rm {CAMERA}")
    pc2.ssh.run(f"mv {CONF}.before {CONF} && systemctl reload dssmd")
    lab.await_streams()


def shape(guest: Guest, receiver: int, mb_per_s: int) -> None:
    """Delays what the guest sends to another one, and limits its rate. The queue holds 40 ms."""
    packets = max(50, mb_per_s * 40_000 // 1500)
    # Not the ssh connections from this machine, which end when their packets are lost for long.
    guest.ssh.run("tc qdisc replace dev vec0 root handle 1: prio bands 4"
                  f" && tc qdisc add dev vec0 parent 1:4 netem delay {ONE_WAY_MS}ms rate {mb_per_s * 8}mbit"
                  f" limit {packets}"
                  " && tc filter add dev vec0 parent 1: protocol ip u32"
                  f" match ip dst {guest_address(receiver)}/32 flowid 1:4")


def measure(lab: Lab, rate: int) -> None:
    """Prints and checks the ages on one network."""
    pc2 = lab["pc2"]
    image_ms = IMAGE_BYTES / rate / 1000
    look = Load(pc2, "look", [CAMERA], RATE_HZ).await_ready()
    watched = max(4.0, 4 * image_ms / 1000)

    def check(when: str) -> None:
        look.ages_us()
        time.sleep(watched)
        median, p99 = (age / 1000 for age in look.ages_us())
        print(f"  | {rate} MB/s, {when}: median {median:.0f} ms, p99 {p99:.0f} ms; an image takes"
              f" {image_ms:.0f} ms", flush=True)
        # Guests stand still for up to a second.
        assert median < 2 * image_ms + 2 * ONE_WAY_MS + 1000 / RATE_HZ + 500, (when, median)

    check("after opening")
    check("later")
    lab.network.part([1], [2])
    time.sleep(CUT_SECONDS)
    lab.network.join()
    healed = time.monotonic()
    while look.ages_us()[0] > CUT_SECONDS * 500_000:
        assert time.monotonic() - healed < 60, "no new image within 60 s of the cut"
        time.sleep(0.1)
    print(f"  | {rate} MB/s: the first image {time.monotonic() - healed:.1f} s after a cut of"
          f" {CUT_SECONDS} s", flush=True)
    check("after the cut")
    look.finish()
