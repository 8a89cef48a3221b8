"""The data in tests/data: small, each beside its notice, none under the GPL."""

from shared_data import BUNDLED

#: files of data may hold this much together
MOST = 6_000_000


def is_notice(path):
    return path.name.upper().startswith("LICENSE")


def test_they_are_small_and_each_has_its_notice_beside_it():
    files = [path for path in BUNDLED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MOST
    for path in files:
        above = [folder for folder in path.parents if BUNDLED in folder.parents]
        own = path.name == "README.md" or is_notice(path)
        assert own or any(is_notice(each) for folder in above for each in folder.iterdir()), path


def test_notices_permit_distribution_and_are_named():
    said = (BUNDLED / "README.md").read_text()
    notices = [path for path in BUNDLED.rglob("*") if is_notice(path)]
    assert len(notices) >= 8
    for path in notices:
        text = " ".join(path.read_text().split())
        free = "Permission is hereby granted, free of charge" in text
        assert free or "Redistribution and use in source and binary forms" in text, path
        assert "GNU" not in text
        assert path.name in said
    # what stands under the GPL, or without a licence, is not here
    names = {path.name for path in BUNDLED.rglob("*")}
    assert not names & {"sierra", "updating", "norms", "compleib-open.npz"}
