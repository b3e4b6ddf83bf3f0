"""Images of every kind become 8-bit sRGB by the rules of the decoder, or are refused by name; none by luck."""

from __future__ import annotations

import io
import struct
import warnings

import numpy as np
import pytest
from PIL import Image, ImageCms

from genre_tasks.errors import InputError
from genre_tasks.scene.image_decoding import decode_pixels, decode_with_facts, inspect_image, read_image_size
from genre_tasks.srgb import linear_to_srgb, srgb_to_linear
from tests.scene.encoded_images import (
    ADOBE_RGB,
    DISPLAY_P3,
    SRGB,
    chunk,
    encode,
    icc_profile,
    picture,
    png_of_rgb16,
    with_chunk,
)

COLORS = picture()
GREY = COLORS[..., 2]


def decode(data: bytes) -> np.ndarray:
    return decode_pixels(data, 64, 36)


def words(data: bytes) -> list[str]:
    """Words of the findings: the same in a check and in a run."""
    decoded = decode_with_facts(data, 64, 36)
    facts = inspect_image(data)
    assert facts == decoded.facts
    assert np.array_equal(decoded.pixels, decode(data))
    return [finding.word for finding in facts.findings]


def refusal(data: bytes) -> InputError:
    """The error, which is the same in a check, in a run and for later stages."""
    errors = []
    for read in (decode, inspect_image, lambda d: decode_with_facts(d, 64, 36)):
        with pytest.raises(InputError) as raised:
            read(data)
        errors.append(raised.value)
    assert len({str(error) for error in errors}) == 1
    assert errors[0].remedy
    return errors[0]


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM"])
@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_ordinary_images_stay_as_pillow_decodes_them(kind: str, mode: str) -> None:
    data = encode(Image.fromarray(COLORS).convert(mode), kind)
    assert np.array_equal(decode(data), np.asarray(Image.open(io.BytesIO(data)).convert("RGB")))
    assert words(data) == []


class TestBitDepth:
    def test_grey_of_16_bits(self) -> None:
        """Report: python-pillow/Pillow#2574 (a 16-bit grey PNG becomes white)."""
        samples = np.random.default_rng(0).integers(0, 65536, GREY.shape, dtype=np.uint16)
        samples[0, :3] = (0, 128, 65535)
        for data in (encode(samples), encode(samples, "TIFF"), encode(samples, "PPM")):
            assert np.abs(decode(data) - samples[..., None] / 257).max() <= 0.5
            assert words(data) == ["reduced_depth"]

    def test_both_byte_orders_of_a_tiff(self) -> None:
        """Report: python-pillow/Pillow#5991 (I;16B is ruined by a conversion)."""
        samples = GREY.astype(np.uint16) * 257
        data = encode(Image.frombytes("I;16B", (64, 36), samples.astype(">u2").tobytes()), "TIFF")
        assert data.startswith(b"MM") and np.array_equal(decode(data), np.stack([GREY] * 3, -1))

    def test_zero_is_white_in_a_tiff_of_16_bits(self) -> None:
        """Report: python-pillow/Pillow#5655 (grey TIFFs whose zero is white)."""
        samples = GREY.astype(np.uint16) * 257
        data = encode(Image.fromarray(65535 - samples), "TIFF", tiffinfo={262: 0})
        assert np.array_equal(decode(data)[..., 0], GREY)

    def test_twelve_bits_of_sixteen_are_a_warning(self) -> None:
        """Report: alliedvision/VmbPy#45 (12-bit frames saved as 16 bits are very dark)."""
        samples = GREY.astype(np.uint16) * 16
        assert words(encode(samples)) == ["reduced_depth", "narrow_range_16_bit"]
        finding = inspect_image(encode(samples)).findings[1]
        assert finding.severity == "warning" and finding.numbers["largest"] == 255 * 16
        assert words(encode(GREY.astype(np.uint16) * 257)) == ["reduced_depth"]

    def test_the_stated_depth_of_a_png_counts_where_samples_stand_in_the_lower_bits(self) -> None:
        """Report: basler/pypylon#594 (Mono12 in the lower bits of 16)."""
        low = (GREY.astype(int) * 4095 // 255).astype(np.uint16)
        data = with_chunk(encode(low), b"sBIT", bytes([12]))
        assert np.array_equal(decode(data)[..., 0], GREY) and words(data) == ["reduced_depth"]
        # As the specification has them: in the upper bits. Dark ones too are not taken for the others.
        for high in (low << 4 | low >> 8, (low >> 4) << 4):
            data = with_chunk(encode(high), b"sBIT", bytes([12]))
            assert np.abs(decode(data)[..., 0] - high / 257).max() <= 0.5

    def test_colours_of_16_bits(self) -> None:
        """Report: python-pillow/Pillow#7723 (16-bit RGB PNGs are read as 8 bits)."""
        data = png_of_rgb16(COLORS.astype(np.uint16) * 257)
        assert np.array_equal(decode(data), COLORS) and words(data) == ["reduced_depth"]
        assert words(png_of_rgb16(COLORS.astype(np.uint16) * 16)) == ["reduced_depth", "narrow_range_16_bit"]

    @pytest.mark.parametrize("bits", [2, 4])
    def test_grey_of_few_bits(self, bits: int) -> None:
        levels = 2**bits - 1
        indices = (GREY.astype(int) * levels // 255).astype(np.uint8)
        palette = Image.fromarray(indices, "P")
        palette.putpalette([v for k in range(levels + 1) for v in [k * 255 // levels] * 3])
        data = encode(palette, bits=bits)
        assert np.array_equal(decode(data)[..., 0], indices.astype(int) * 255 // levels) and words(data) == []

    def test_one_bit(self) -> None:
        data = encode(Image.fromarray(GREY > 99))
        assert np.array_equal(decode(data)[..., 1], np.where(GREY > 99, 255, 0))
        assert words(data) == ["one_bit_image"]

    @pytest.mark.parametrize("samples", [GREY / np.float32(255), GREY.astype(np.int32) * 1000])
    def test_numbers_of_no_known_range_are_refused(self, samples: np.ndarray) -> None:
        """Report: python-pillow/Pillow#3159 (conversions clip and do not scale)."""
        error = refusal(encode(samples, "TIFF"))
        assert "range" in error.problem and "8-bit" in error.remedy

    def test_signed_samples_are_refused(self) -> None:
        assert "unsigned" in refusal(encode(GREY, "TIFF", tiffinfo={339: 2})).problem


class TestAlpha:
    def test_opaque_alpha_is_ignored(self) -> None:
        opaque = np.dstack([COLORS, np.full(GREY.shape, 255, np.uint8)])
        assert np.array_equal(decode(encode(opaque)), COLORS) and words(encode(opaque)) == []

    def test_transparent_pixels_keep_their_colours_and_are_a_warning(self) -> None:
        """Report: graphdeco-inria/gaussian-splatting#64 (what masked areas of RGBA images become)."""
        alpha = np.where(GREY > 127, 255, 0).astype(np.uint8)
        share = float((alpha == 0).mean())
        for data in (encode(np.dstack([COLORS, alpha])), encode(np.dstack([COLORS, alpha]), "TIFF")):
            assert np.array_equal(decode(data), COLORS) and words(data) == ["transparent_image"]
            assert inspect_image(data).findings[0].numbers["share"] == share

    def test_grey_with_alpha(self) -> None:
        data = encode(Image.merge("LA", [Image.fromarray(GREY), Image.fromarray(GREY)]))
        assert np.array_equal(decode(data)[..., 0], GREY) and words(data) == ["transparent_image"]

    def test_a_transparent_colour(self) -> None:
        grey16 = GREY.astype(np.uint16) * 257
        assert words(encode(COLORS, transparency=(0, 0, 0))) == ["transparent_image"]
        assert words(encode(GREY, transparency=0)) == ["transparent_image"]
        assert words(with_chunk(encode(grey16), b"tRNS", b"\xff\xff")) == ["reduced_depth", "transparent_image"][::-1]

    def test_premultiplied_colours_are_divided(self) -> None:
        """Report: graphdeco-inria/gaussian-splatting#1193 (colours multiplied by alpha give other Gaussians)."""
        alpha = np.full(GREY.shape, 128, np.uint8)
        halved = Image.fromarray(np.dstack([(COLORS.astype(int) * 128 // 255).astype(np.uint8), alpha]))
        straight = struct.pack("<HHIHH", 338, 3, 1, 2, 0)
        data = encode(halved, "TIFF").replace(straight, struct.pack("<HHIHH", 338, 3, 1, 1, 0))
        assert straight not in data
        assert np.abs(decode(data).astype(int) - COLORS).max() <= 2


class TestPalette:
    def test_colours_of_a_palette(self) -> None:
        """Report: imageio/imageio#475 (palettes with transparency are read as something else)."""
        palette = Image.fromarray(COLORS).quantize(64)
        expected = np.asarray(palette.convert("RGB"))
        for data in (encode(palette), encode(palette, "GIF")):
            assert np.array_equal(decode(data), expected) and words(data) == []

    def test_transparent_entries(self) -> None:
        palette = Image.fromarray(COLORS).quantize(64)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert words(encode(palette, transparency=3)) == ["transparent_image"]
            assert words(encode(palette, transparency=bytes([128] * 64))) == ["transparent_image"]
            assert words(encode(palette, transparency=bytes([255] * 64))) == []


class TestColorSpaces:
    def test_an_srgb_profile_changes_nothing(self) -> None:
        for profile in (icc_profile(SRGB, None), ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()):
            for kind in ("PNG", "JPEG"):
                data = encode(COLORS, kind, icc_profile=profile)
                assert np.array_equal(decode(data), decode(encode(COLORS, kind))) and words(data) == []

    @pytest.mark.parametrize(("primaries", "gamma"), [(DISPLAY_P3, None), (ADOBE_RGB, 2.2), (SRGB, 1.0)])
    def test_other_profiles_are_converted(self, primaries: tuple[tuple[float, ...], ...], gamma: float | None) -> None:
        """Report: OpenDisplay/Home_Assistant_Integration#73 (Adobe RGB and Display P3 taken as sRGB)."""
        share = COLORS / 255
        light = srgb_to_linear(share) if gamma is None else share**gamma
        srgb_light = light @ np.array(primaries) @ np.linalg.inv(np.array(SRGB))
        expected = 255 * linear_to_srgb(np.clip(srgb_light, 0, 1))
        data = encode(COLORS, icc_profile=icc_profile(primaries, gamma))
        assert np.abs(decode(data) - expected).max() <= 4 and words(data) == ["converted_colors"]
        assert np.abs(decode(data).astype(int) - COLORS).max() > 20

    def test_a_grey_image_with_a_colour_profile(self) -> None:
        data = encode(GREY, "JPEG", icc_profile=icc_profile(SRGB, 1.0), quality=95)
        expected = 255 * linear_to_srgb(GREY[4:-4, 16:-16] / 255)
        assert np.abs(decode(data)[4:-4, 16:-16, 0] - expected).mean() <= 2 and words(data) == ["converted_colors"]

    @pytest.mark.parametrize("profile", [b"no profile", icc_profile(SRGB, None)[:200]])
    def test_a_damaged_profile_is_a_warning(self, profile: bytes) -> None:
        """Report: pbs/its#180 (profiles that Pillow cannot transform)."""
        data = encode(COLORS, icc_profile=profile)
        assert np.array_equal(decode(data), COLORS) and words(data) == ["unconverted_colors"]

    def test_inks(self) -> None:
        """Report: haraldk/TwelveMonkeys#147 (CMYK of Adobe is stored inverted)."""
        inks = Image.fromarray(COLORS).convert("CMYK")
        for data in (encode(inks, "TIFF"), encode(inks, "JPEG", quality=98, subsampling=0)):
            assert np.abs(decode(data).astype(int) - COLORS).mean() <= 2 and words(data) == ["converted_colors"]

    def test_luma_and_chroma_in_a_tiff(self) -> None:
        data = encode(Image.fromarray(COLORS).convert("YCbCr"), "TIFF")
        assert np.abs(decode(data).astype(int) - COLORS).max() <= 3 and words(data) == ["converted_colors"]

    def test_lab(self) -> None:
        profiles = (ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"))
        lab = ImageCms.applyTransform(
            Image.fromarray(COLORS), ImageCms.buildTransform(*profiles, "RGB", "LAB", ImageCms.Intent(1))
        )
        data = encode(lab, "TIFF")
        assert np.abs(decode(data).astype(int) - COLORS).mean() <= 3 and words(data) == ["converted_colors"]


class TestPngColor:
    def test_linear_samples(self) -> None:
        """Report: imageio/imageio#366 (when gAMA is to be applied)."""
        linear = with_chunk(encode(COLORS), b"gAMA", struct.pack(">I", 100_000))
        assert np.abs(decode(linear) - 255 * linear_to_srgb(COLORS / 255)).max() <= 0.5
        assert words(linear) == ["converted_colors"]
        grey = GREY.astype(np.uint16) * 257
        linear = with_chunk(encode(grey), b"gAMA", struct.pack(">I", 100_000))
        assert np.abs(decode(linear)[..., 0] - 255 * linear_to_srgb(GREY / 255)).max() <= 0.5

    def test_the_gamma_of_srgb_changes_nothing(self) -> None:
        usual = with_chunk(encode(COLORS), b"gAMA", struct.pack(">I", 45455))
        assert np.array_equal(decode(usual), COLORS) and words(usual) == []
        overruled = with_chunk(with_chunk(encode(COLORS), b"gAMA", struct.pack(">I", 100_000)), b"sRGB", b"\0")
        assert np.array_equal(decode(overruled), COLORS) and words(overruled) == []

    def test_other_primaries_are_a_warning(self) -> None:
        p3 = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
        srgb = struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)
        assert words(with_chunk(encode(COLORS), b"cHRM", p3)) == ["unconverted_colors"]
        assert words(with_chunk(encode(COLORS), b"cHRM", srgb)) == []

    def test_hdr_and_wide_gamut_are_refused(self) -> None:
        for code in (bytes([9, 16, 0, 1]), bytes([9, 18, 0, 1]), bytes([12, 13, 0, 1]), bytes([1, 8, 0, 1])):
            assert "sRGB" in refusal(with_chunk(encode(COLORS), b"cICP", code)).problem
        assert words(with_chunk(encode(COLORS), b"cICP", bytes([1, 13, 0, 1]))) == []


class TestOrientation:
    @pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
    @pytest.mark.parametrize("orientation", [2, 3, 6, 8])
    def test_turned_images_are_refused(self, kind: str, orientation: int) -> None:
        """Report: cdcseacave/openMVS#777 (intrinsics do not match once the EXIF orientation is applied)."""
        exif = Image.Exif()
        exif[0x0112] = orientation
        error = refusal(encode(COLORS, kind, exif=exif))
        assert f"orientation is {orientation}" in error.problem and "exiftool" in error.remedy

    @pytest.mark.parametrize("orientation", [0, 1, 9])
    def test_upright_images_are_taken(self, orientation: int) -> None:
        exif = Image.Exif()
        exif[0x0112] = orientation
        assert words(encode(COLORS, "JPEG", exif=exif)) == []

    def test_exif_behind_the_pixels_of_a_png(self) -> None:
        exif = Image.Exif()
        exif[0x0112] = 6
        content = exif.tobytes().removeprefix(b"Exif\0\0")
        assert "orientation" in refusal(with_chunk(encode(COLORS), b"eXIf", content, at_end=True)).problem

    def test_damaged_exif_asks_for_nothing(self) -> None:
        assert words(encode(COLORS, "JPEG", exif=b"Exif\0\0nonsense")) == []


class TestSeveralPictures:
    @pytest.mark.parametrize("kind", ["GIF", "PNG", "WEBP", "TIFF"])
    def test_the_first_one_is_taken_with_a_warning(self, kind: str) -> None:
        """Report: napari/napari#3745 (of an animation, only the first frame is loaded)."""
        first = Image.fromarray(GREY)
        options = {"lossless": True} if kind == "WEBP" else {}
        data = encode(first, kind, save_all=True, append_images=[Image.fromarray(255 - GREY)], **options)
        assert np.array_equal(decode(data)[..., 0], GREY) and words(data) == ["several_pictures"]
        assert inspect_image(data).findings[0].numbers["pictures"] == 2

    def test_a_jpeg_with_a_main_picture_is_a_note(self) -> None:
        data = encode(Image.fromarray(COLORS), "MPO", save_all=True, append_images=[Image.fromarray(GREY)])
        (finding,) = inspect_image(data).findings
        assert (finding.word, finding.severity) == ("several_pictures", "note")


class TestRefused:
    @pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "BMP", "TIFF", "GIF", "AVIF"])
    def test_truncated_files(self, kind: str) -> None:
        """Report: tianzhi0549/FCOS#206 (image file is truncated)."""
        noise = np.random.default_rng(0).integers(0, 256, (36, 64, 3), dtype=np.uint8)
        data = encode(noise, kind)
        for size in (10, len(data) // 2, len(data) - 40):
            assert "cannot decode the image" in refusal(data[:size]).problem

    def test_a_jpeg_whose_end_is_zeros(self) -> None:
        """Report: none found; case 1 of the list of odd logs."""
        data = encode(COLORS, "JPEG", quality=95)
        assert "zeros" in refusal(data[: len(data) // 2].ljust(len(data), b"\0")).problem
        assert words(data + bytes(100)) == []

    @pytest.mark.parametrize(
        ("data", "kind"),
        [
            (b"", "empty"),
            (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "Git LFS"),
            (b"<!DOCTYPE html><html><body>Log in</body></html>", "web page"),
            (b"no image at all", "unknown"),
        ],
    )
    def test_what_is_no_image_is_named(self, data: bytes, kind: str) -> None:
        """Report: git-lfs/git-lfs#4830 (a pointer in place of the data)."""
        error = refusal(data)
        assert kind in error.problem
        # An address in memory would make the result differ from run to run.
        assert "0x" not in str(error)

    def test_absurd_sizes(self) -> None:
        """Report: none found; case 1 of the list of odd logs."""
        header = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
        small = struct.pack(">IIBBBBB", 11_000, 11_000, 8, 2, 0, 0, 0)
        for content in (header, small):
            sound = encode(COLORS)
            assert "pixels" in refusal(sound[:8] + chunk(b"IHDR", content) + sound[33:]).problem

    def test_a_format_that_would_start_a_program(self) -> None:
        postscript = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n"
        assert "cannot decode" in refusal(postscript).problem


class TestBlank:
    @pytest.mark.parametrize("level", [0, 117, 255])
    @pytest.mark.parametrize("kind", ["PNG", "JPEG"])
    def test_one_colour_all_over(self, kind: str, level: int) -> None:
        """Report: ros-drivers/flir_camera_driver#200 (incomplete frames arrive as black images)."""
        data = encode(np.full((360, 640, 3), level, np.uint8), kind)
        assert inspect_image(data).is_blank and decode_with_facts(data, 64, 36).facts.is_blank

    def test_noise_of_a_covered_lens(self) -> None:
        dark = np.random.default_rng(0).integers(0, 5, (720, 1280, 3), dtype=np.uint8)
        data = encode(dark, "JPEG")
        assert inspect_image(data).is_blank and decode_with_facts(data, 320, 180).facts.is_blank

    def test_a_lamp_at_night_is_a_picture(self) -> None:
        night = np.zeros((360, 640, 3), np.uint8)
        night[100:110, 200:210] = 200
        for kind in ("PNG", "JPEG"):
            assert not inspect_image(encode(night, kind)).is_blank
        assert not inspect_image(encode(COLORS)).is_blank

    def test_a_single_pixel(self) -> None:
        data = encode(np.zeros((1, 1, 3), np.uint8))
        assert inspect_image(data).is_blank and read_image_size(data) == (1, 1)
