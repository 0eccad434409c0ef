"""Words that mean something to the readers."""


def _words(text: str, *more: bytes) -> tuple[bytes, ...]:
    return (*(word.encode() for word in text.split()), *more)


YAML = _words(
    """&a *a !!binary !!timestamp !!set !!omap !!int !!float !!python/object/apply:os.system <<: --- ... %YAML:1.0 %TAG
    !!opencv-matrix .inf .nan 0x1F 1_000 1e400 ~ | > ? : - {{ [[ ]] }} # ' " 0o7 1:60:60 2021-13-45 null true [ {a:
    2021-02-30T25:61:61Z""",
    *(b"\t", b"\r", b"\0", b"\xef\xbb\xbf", b"\xc2\x85", b"a: &x [*x]\n", b"? [a]\n: b\n", b"- "),
    b"- &b [*a, *a, *a, *a, *a, *a, *a, *a, *a]\n",
)
POSE = _words(
    "# , nan ٣",
    *(b"\r\n", b"\t", b"\0", b"\x0b", b"\xef\xbb\xbf", b"timestamp tx ty tz qx qy qz qw\n"),
)
PCD = _words(
    """FIELDS COLUMNS SIZE TYPE COUNT WIDTH HEIGHT POINTS DATA VIEWPOINT binary ascii binary_compressed x y z
    F I U 8 4 2 1 0""",
    *(b"\n", b" ", b"\nDATA binary\n", b"\xff"),
)
PLY = _words("property list uchar x", b"element vertex", b"end_header\n")
PNG = _words("IDAT IHDR PLTE tRNS acTL IEND")
JPEG = (
    *(b"\xff\xd8", b"\xff\xd9", b"\xff\xda", b"\xff\xc0", b"\xff\xc2", b"\xff\xc4", b"\xff\xd0", b"\xff\0"),
    b"\xff\xdd\0\4\0\1",
)
ZIP = _words("../ / \\ ~ con ä ..", b"PK\1\2", b"PK\3\4", b"PK\5\6", b"PK\6\6", b"PK\6\7", b"\0")
TAR = _words("ustar ../ / L x g path= size=", b"\0", b"30 ")
