import pytest

from capture.errors import SourceError
from capture.importers import ImportOptions, import_source


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: [], "nothing to import"),
        (lambda folder: [folder / "none"], "does not exist"),
        (lambda folder: [folder], "no source that can be imported"),
        (lambda folder: [folder / "notes.txt"], "no source that can be imported"),
        (lambda folder: [folder / "notes.txt", folder / "a.json"], "Several sources"),
        (lambda folder: [folder / "a.json"], '"frames" is missing'),
        (lambda folder: [folder / "b.json"], "one JSON object"),
    ],
)
def test_what_cannot_be_imported_is_said(tmp_path, make, words):
    (tmp_path / "source").mkdir()
    (tmp_path / "source/notes.txt").write_text("x")
    (tmp_path / "source/a.json").write_text("{}")
    (tmp_path / "source/b.json").write_text("[]")
    with pytest.raises(SourceError, match=words):
        import_source(make(tmp_path / "source"), tmp_path / "S", ImportOptions())
    assert not (tmp_path / "S").exists()
