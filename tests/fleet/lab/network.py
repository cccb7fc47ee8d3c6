# SPDX-License-Identifier: Apache-2.0
"""The network between the guests: a bridge with a tap for each guest, and ways to cut it.

It is in the network namespace of the harness (run), so names and addresses are the same in every run
and nothing must be removed.
"""

from collections.abc import Collection

from lab.command import run

BRIDGE = "lab"
HOST_ADDRESS = "10.99.0.254"


def guest_name(number: int) -> str:
    """The name of guest `number`, counted from 1."""
    return f"pc{number}"


def guest_address(number: int) -> str:
    """The address of guest `number`."""
    return f"10.99.0.{number}"


def tap(number: int) -> str:
    """The end of guest `number`'s cable on this machine."""
    return f"tap{number}"


class Network:
    """A switch with a port for each of `guests` PCs and one for this machine."""

    def __init__(self, guests: int) -> None:
        self._ip("link", "set", "lo", "up")
        # With snooping, the bridge would not forward mDNS to guests that have not joined the group yet.
        self._ip("link", "add", BRIDGE, "type", "bridge", "mcast_snooping", "0", "forward_delay", "0")
        self._ip("address", "add", f"{HOST_ADDRESS}/24", "dev", BRIDGE)
        self._ip("link", "set", BRIDGE, "up")
        for number in range(1, guests + 1):
            self._ip("tuntap", "add", tap(number), "mode", "tap")
            self._ip("link", "set", tap(number), "master", BRIDGE, "up")
        self._nft("add table bridge lab; add set bridge lab blocked { type ifname . ifname; };"
                  " add chain bridge lab forward { type filter hook forward priority 0; };"
                  " add rule bridge lab forward iifname . oifname @blocked drop")

    def unplug(self, number: int) -> None:
        """Pulls the cable of a guest; this machine cannot reach the guest either."""
        # With the tap down, the guest's writes would fail, and UML's driver does not recover from that.
        self._ip("link", "set", tap(number), "nomaster")

    def plug(self, number: int) -> None:
        """Reconnects the cable of a guest."""
        self._ip("link", "set", tap(number), "master", BRIDGE)

    def part(self, left: Collection[int], right: Collection[int]) -> None:
        """Blocks packets between two groups of guests; ssh from this machine still works."""
        for one in left:
            for other in right:
                self.block(one, other)
                self.block(other, one)

    def block(self, sender: int, receiver: int) -> None:
        """Blocks packets of one guest to another, and only in this direction."""
        self._nft(f"add element bridge lab blocked {{ {tap(sender)} . {tap(receiver)} }}")

    def join(self) -> None:
        """Ends the effect of part() and block()."""
        self._nft("flush set bridge lab blocked")

    @staticmethod
    def _ip(*arguments: str) -> None:
        run("ip", *arguments, what="set up the lab's network")

    @staticmethod
    def _nft(rules: str) -> None:
        run("nft", rules, what="filter between the guests")
