"""What is kept, and how it is asked. `Warehouse(root)` answers; the modules beside it write."""

from warehouse.errors import WarehouseError
from warehouse.query import Warehouse

__all__ = ["Warehouse", "WarehouseError"]
