def write_figures(rows, folder):
    return []
