"""The paper's claims as data: what each trains, on which scenes, and by which rule it holds."""
