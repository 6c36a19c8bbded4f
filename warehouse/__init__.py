"""What is kept, and how it is asked. `Warehouse(root)` answers; the modules beside it write."""

if __name__ != "fieldcal.warehouse":  # a checkout has this folder at its root too: two copies of every flow and enum
    raise ImportError("This package is fieldcal.warehouse.")

from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.query import Warehouse

__all__ = ["Warehouse", "WarehouseError"]
