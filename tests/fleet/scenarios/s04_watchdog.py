# SPDX-License-Identifier: Apache-2.0
"""A hung dssmd is killed by systemd's watchdog and started again, and no sample is lost"""

from lab.dssmd import await_news, await_restarted, main_pid
from lab.lab import Lab
from lab.load import Load, expect_complete
from test_report import Skip

STREAM = "watched:0@pc1"


def run(lab: Lab) -> None:
    """Stops dssmd by SIGSTOP and waits for another one."""
    pc1, pc2, _ = lab.guests
    if pc1.ssh.run("systemctl show --property=WatchdogUSec --value dssmd").strip() in ("0", "infinity"):
        raise Skip("the installed dssmd.service has no WatchdogSec")
    writer = Load(pc1, "write", [STREAM]).await_ready()
    readers = [Load(guest, "read", [STREAM]).await_ready() for guest in (pc1, pc2)]
    before = main_pid(pc1)
    pc1.ssh.run(f"kill -STOP {before}")
    await_restarted(pc1, before)
    assert "watchdog" in pc1.ssh.run("journalctl --no-pager --unit=dssmd --grep='[Ww]atchdog'").lower()
    await_news([STREAM], pc2)
    written = writer.finish()
    for reader in readers:
        expect_complete(written, reader.finish(), "reader")
    pc1.ssh.run(f"dssmctl rm {STREAM}")
    lab.await_streams()
