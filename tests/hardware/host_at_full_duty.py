"""A host that runs the pump at full duty and renews its lease, until somebody kills or stops this process."""

import sys
import time

from rainstereo.hardware.pump import Pump
from rainstereo.hardware.regime import Segment

with Pump.open(sys.argv[1]) as pump:
    pump.arm()
    pump.run(Segment(1000, 600_000))
    print("running", flush=True)
    while True:
        pump.renew()
        time.sleep(0.05)
