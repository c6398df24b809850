HIRO = None
