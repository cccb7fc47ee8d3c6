# SPDX-License-Identifier: Apache-2.0
"""All PCs reboot at once and are a vehicle again with no help"""

from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.load import Load

UNIT = "fleet-sensor"


def run(lab: Lab) -> None:
    """Gives each PC a sensor that starts with it, and reboots all."""
    names = [f"sensor:0@{guest.name}" for guest in lab.guests]
    boots = lab.on_all(boot_id)
    lab.on_all(install_sensor)
    with lab.spread():
        lab.on_all(lambda guest: guest.ssh.attempt("systemctl reboot"))
        for guest, before in zip(lab.guests, boots):
            guest.ssh.close()
            await_that(f"{guest.name} boots anew", lambda guest=guest, before=before:
                       (guest.answers() and boot_id(guest) != before, before), seconds=180)
        lab.on_all(Guest.await_running)
    lab.await_streams(*names)
    pc3 = lab["pc3"]
    Load(pc3, "read", names, rate_hz=100).await_ready().abandon()
    lab.on_all(remove_sensor)
    lab.await_streams()


def boot_id(guest: Guest) -> str:
    """Differs after each boot; empty while the guest does not say."""
    return guest.ssh.attempt("cat /proc/sys/kernel/random/boot_id").stdout.decode()


def install_sensor(guest: Guest) -> None:
    """A program that writes from boot on."""
    guest.ssh.run(f"""cat > /etc/systemd/system/{UNIT}.service <<'END'
[Unit]
After=dssmd.service
[Service]
ExecStart=/bin/sh -c 'sleep infinity | /opt/fleet/fleet-load write 100 sensor:0@{guest.name}'
Restart=always
[Install]
WantedBy=multi-user.target
END
systemctl daemon-reload && systemctl enable {UNIT} && sync""")


def remove_sensor(guest: Guest) -> None:
    """As it was before."""
    guest.ssh.run(f"systemctl disable --now {UNIT}; rm /etc/systemd/system/{UNIT}.service;"
                  " systemctl daemon-reload; dssmctl rm sensor")
