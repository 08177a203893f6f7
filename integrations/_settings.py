"""Settings of other rasterizers: Inria's twelve fields, then one of their own, then the package's others."""
from __future__ import annotations

from collections import namedtuple

from diff_smoe_rasterization import GaussianRasterizationSettings as Settings


def settings_with(name: str, module: str) -> type:
    """Returns the package's settings as a class whose thirteenth field is `name`.

    A field that the package has too moves there with its default; another one has the default None.
    module: the name of the module whose class it is, by which pickle finds it.
    """
    fields = [field for field in Settings._fields if field != name]
    fields.insert(fields.index("debug") + 1, name)
    defaults = {name: None, **Settings._field_defaults}
    return namedtuple("GaussianRasterizationSettings", fields, module=module,
                      defaults=[defaults[field] for field in fields if field in defaults])
