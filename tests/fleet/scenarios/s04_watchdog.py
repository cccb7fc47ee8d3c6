# SPDX-License-Identifier: Apache-2.0
"""systemd's watchdog restarts a hung dssmd, and no sample is lost"""

from lab.dssmd import await_new_samples, await_restarted, main_pid
from lab.guest import Guest
from lab.lab import Lab
from lab.load import RATE_HZ, Load, expect_complete

STREAM = "watched:0@pc1"
# Shorter than the unit's limit, to save time.
LIMIT = "2s"
DROP_IN = "/run/systemd/system/dssmd.service.d/fleet.conf"


def run(lab: Lab) -> None:
    """Stops dssmd by SIGSTOP and waits for another one."""
    pc1, pc2, _ = lab.guests
    limit = watchdog(pc1)
    assert limit not in ("0", "infinity"), "the installed dssmd.service has no WatchdogSec"
    pc1.ssh.run(f"mkdir -p $(dirname {DROP_IN}) && printf '[Service]\\nWatchdogSec={LIMIT}\\n' > {DROP_IN}"
                " && systemctl daemon-reload && systemctl restart dssmd")
    writer = Load(pc1, "write", [STREAM]).await_ready()
    readers = [Load(guest, "read", [STREAM]).await_ready() for guest in (pc1, pc2)]
    before = main_pid(pc1)
    pc1.ssh.run(f"kill -STOP {before}")
    readers[0].await_more(RATE_HZ)
    await_restarted(pc1, before)
    pc1.ssh.run(f"journalctl --unit=dssmd --grep='Watchdog timeout .limit {LIMIT}'")
    await_new_samples([STREAM], pc2)
    written = writer.finish()
    for reader in readers:
        expect_complete(written, reader.finish(), "reader")
    pc1.ssh.run(f"dssmctl rm {STREAM}; rm {DROP_IN}; systemctl daemon-reload; systemctl restart dssmd")
    assert watchdog(pc1) == limit
    lab.await_streams()


def watchdog(guest: Guest) -> str:
    """The WatchdogSec of dssmd in systemd there."""
    return guest.ssh.run("systemctl show --property=WatchdogUSec --value dssmd").strip()
