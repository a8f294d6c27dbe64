"""Where a case of a store is computed again."""

from contextlib import suppress

from wavequake.campaign.store.store import Manifest
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device


def device_at_hand(manifest: Manifest) -> str:
    """Return the store's own device, or where that is missing one of its kind, or NumPy."""
    for request in (manifest.device, manifest.device_kind):
        with suppress(UserError):
            return choose_device(request).name
    return "numpy"
