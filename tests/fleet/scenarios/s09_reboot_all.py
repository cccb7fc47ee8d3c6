# SPDX-License-Identifier: Apache-2.0
"""All PCs reboot at once and are a vehicle again with no help

Nobody does anything after the power is back: dssmd, clocks, Avahi and a sensor of each PC start with
it, whichever is first, and then each PC is well and lists all sensors.
"""

from lab.guest import Guest
from lab.lab import Lab
from lab.load import Load

UNIT = "fleet-sensor"


def run(lab: Lab) -> None:
    """Gives each PC a sensor that starts with it, and reboots all."""
    names = [f"sensor:0@{guest.name}" for guest in lab.guests]
    lab.on_all(install_sensor)
    with lab.spread():
        lab.on_all(lambda guest: guest.reboot(lab.all_cores))
        lab.on_all(Guest.await_running)
    lab.await_streams(*names)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl doctor"))
    reader = Load(lab["pc3"], "read", names, rate_hz=100).await_ready()
    found = reader.finish()
    assert not found["faults"], found["faults"]
    lab.on_all(remove_sensor)
    lab.await_streams()


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
