"""A host that runs the pump at full duty and renews its lease, until somebody kills or stops this process."""

import sys
import time

from rainstereo.hardware.pump import Pump, PumpError
from rainstereo.hardware.regime import Segment

try:
    with Pump.open(sys.argv[1]) as pump:
        pump.arm()
        pump.run(Segment(1000, 600_000))
        print("running", flush=True)
        while True:
            pump.renew()
            time.sleep(0.05)
except PumpError as error:  # of whatever kind: the host may have been stopped while it wrote, read or waited
    sys.exit(f"stopped for good: {error}")
