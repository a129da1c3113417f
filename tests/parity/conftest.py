from engine.conftest import device as device, pool as pool
