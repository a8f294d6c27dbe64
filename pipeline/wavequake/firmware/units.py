"""Control units of the lens experiment that run the firmware on the host, for thousands of blows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.kept import host_image
from wavequake.firmware.loop import positions_of


@dataclass(frozen=True)
class FirmwareUnit:
    """Runs regulators in the firmware's arithmetic, as `wavequake.control.experiment.ControlUnit` asks.

    Attributes
    ----------
    chain : SensorChain
    arithmetic : str
        "float", "q31" or "q16".
    keep : bool
        Whether a design comes again: its image is then built once for all processes.
    """

    chain: SensorChain
    arithmetic: str
    keep: bool = True

    def __call__(self, regulator: ModalRegulator, codes: NDArray[np.int64]) -> Array:
        """Run the firmware from a blow at the first sample on: codes (k,) in, commands (k,) in m out.

        Raises
        ------
        UserError
            If the gains are out of the arithmetic's range, or there is no compiler.
        """
        gains = gains_of(regulator, self.chain, self.arithmetic)
        with host_image(gains, keep=self.keep) as image:
            device = HostDevice(image)
        trigger = np.zeros(len(codes), dtype=np.bool_)
        trigger[:1] = True
        try:
            return positions_of(device.run(codes.astype(np.uint16), trigger), self.chain.reach)
        finally:
            device.close()
