"""Model of the skin in a cell file: designs of pads, and the placement of pads."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from penumbra.shared.cell.faults import refuse
from penumbra.shared.cell.fields import Angles3, Length, Metres, Model, Name, NotNegative, Number, Positive, Vector3, Whole
from penumbra.shared.geometry import rigid


class Nominal(Model):
    """Designed response [V] of an electrode to a forearm that lies across the pad at the gap d [m]: a1 / (1 + a2 d^2)."""

    a1: Positive = Field(description="amplitude at contact [V]")
    a2: Positive = Field(description="decay with the gap [1/m^2]")


class Electrode(Model):
    """A measurement electrode in its pad's frame (x right, y up, z out of the pad): a disc or an arc around its centre."""

    centre: tuple[Metres, Metres] = Field(default=(0.0, 0.0), description="x, y of the disc's or arc's centre [m]")
    disc: Length | None = Field(default=None, description="radius of a disc [m]; either this or arc")
    arc: tuple[Length, Length] | None = Field(
        default=None, description="inner and outer radius of an arc [m]; either this or disc"
    )
    towards: Annotated[Number, Field(ge=-360, le=360)] = Field(
        default=0.0, description="direction of an arc's middle from x [degrees]"
    )
    half_angle: Annotated[Number, Field(gt=0, le=180)] = Field(default=180.0, description="of an arc, to both sides [degrees]")
    law: Nominal = Field(description="its response as designed")

    @model_validator(mode="after")
    def _one_shape(self) -> Electrode:
        if (self.disc is None) == (self.arc is None):
            got = "neither" if self.arc is None else "both"
            refuse([("", f"expected either disc (a radius) or arc (two radii), got {got}; give one of them")])
        if self.arc is not None and self.arc[0] >= self.arc[1]:
            refuse([("arc", f"expected the inner radius before a larger outer one, got {list(self.arc)}; exchange them")])
        return self

    @cached_property
    def centroid(self) -> tuple[float, float]:
        """The centroid of its area [m]."""
        if self.arc is None:
            return self.centre
        (inner, outer), half = self.arc, np.radians(self.half_angle)
        radius = 2.0 / 3.0 * (outer**3 - inner**3) / (outer**2 - inner**2) * np.sin(half) / half
        angle = np.radians(self.towards)
        return (float(self.centre[0] + radius * np.cos(angle)), float(self.centre[1] + radius * np.sin(angle)))


class Board(Model):
    """A printed board with its electrodes on the front and a ground pour on its back."""

    size: tuple[Length, Length] = Field(description="along x and y [m]")
    ground: tuple[Length, Length] = Field(description="the ground pour along x and y [m]")
    thickness: Annotated[Number, Field(gt=0, le=0.1)] = Field(description="of the laminate [m]")
    permittivity: Annotated[Number, Field(ge=1, le=100)] = Field(default=4.5, description="relative permittivity of the laminate")


class Ring(Model):
    """The excitation ring."""

    radii: tuple[Length, Length] = Field(description="inner and outer radius [m]")
    centre: tuple[Metres, Metres] = Field(default=(0.0, 0.0), description="x, y of its centre [m]")

    @model_validator(mode="after")
    def _ordered(self) -> Ring:
        if self.radii[0] >= self.radii[1]:
            refuse([("radii", f"expected the inner radius before a larger outer one, got {list(self.radii)}; exchange them")])
        return self


class Chain(Model):
    """From a change of capacitance to an amplitude. The amplifier works around half of the converter's reference, so amplitudes
    end there."""

    excitation_V: Annotated[Number, Field(gt=0, le=1e4)] = Field(description="amplitude of the excitation [V]")
    frequency_hz: Annotated[Number, Field(gt=0, le=1e9)] = Field(description="of the excitation [Hz]")
    feedback_ohm: Annotated[Number, Field(gt=0, le=1e12)] = Field(description="the amplifier's feedback resistance [ohm]")
    adc_bits: Annotated[Whole, Field(ge=1, le=24)] = Field(default=12, description="resolution of the converter [bit]")
    adc_reference: Annotated[Number, Field(gt=0, le=100)] = Field(default=3.3, description="reference of the converter [V]")

    @cached_property
    def sensitivity(self) -> float:
        """Amplitude per change of capacitance [V/fF]."""
        return self.excitation_V * 2.0 * np.pi * self.frequency_hz * self.feedback_ohm * 1e-15


class Rest(Model):
    """Designed amplitude without an object near."""

    a3: NotNegative = Field(description="offset [V]")
    polarity: Literal[-1, 1] = Field(default=1, description="whether it rises (1) or falls (-1) where something comes near")
    noise: NotNegative = Field(description="variance of the noise in a sample of one millisecond [V^2]")


class Law(Model):
    """Calibrated response of an electrode, the paper's law (eq. sensor_approx): v = a3 + polarity * a1 / (1 + a2 d^2), where d is
    the gap to the skin [m]."""

    a1: Positive = Field(description="amplitude at contact [V]")
    a2: Positive = Field(description="decay with the gap [1/m^2]")
    a3: NotNegative = Field(description="offset [V]")
    polarity: Literal[-1, 1] = Field(default=1, description="whether it rises (1) or falls (-1) where something comes near")
    noise: NotNegative = Field(description="variance of the noise in a sample of one millisecond [V^2]")


class PadType(Model):
    """A design of pads."""

    board: Board = Field(description="the printed board, for the field model")
    ring: Ring = Field(description="the excitation ring, for the field model")
    electrodes: Annotated[dict[Name, Electrode], Field(min_length=1)] = Field(description="by name")
    chain: Chain = Field(description="amplifier and converter")
    rest: Rest = Field(description="the amplitude with nothing near")
    range: Annotated[Number, Field(gt=0, le=2)] = Field(default=0.15, description="how far it senses [m]")

    @model_validator(mode="after")
    def _possible(self) -> PadType:
        faults = []
        half = np.asarray(self.board.size) / 2.0
        for name, electrode in self.electrodes.items():
            if np.any(np.abs(electrode.centroid) > half):
                at = ", ".join(f"{value:.3g}" for value in electrode.centroid)
                where = f"expected an electrode on its board, {half[0]:g} m to both sides along x and {half[1]:g} m along y"
                faults.append((f"electrodes.{name}", f"{where}, got one around ({at}); give metres"))
        if self.rest.a3 >= self.chain.adc_reference / 2.0:
            most = self.chain.adc_reference / 2.0
            faults.append(("rest.a3", f"expected an offset below half of adc_reference, {most:g} V, got {self.rest.a3:g}"))
        refuse(faults)
        return self

    def law(self, electrode: str) -> Law:
        """The designed law of an electrode."""
        nominal = self.electrodes[electrode].law
        return Law(a1=nominal.a1, a2=nominal.a2, a3=self.rest.a3, polarity=self.rest.polarity, noise=self.rest.noise)


class SensingBoard(Model):
    """A sensing board of a pad."""

    port: str | None = Field(default=None, description="its serial port; without it, `penumbra skin --device` names it")
    channels: Annotated[dict[Name, tuple[Annotated[Whole, Field(ge=0, le=5)], ...]], Field(min_length=1)] = Field(
        description="which of its six channels, 0 to 5, measure which electrode"
    )

    @model_validator(mode="after")
    def _apart(self) -> SensingBoard:
        owners: dict[int, str] = {}
        faults = []
        for name, channels in self.channels.items():
            if not channels:
                faults.append((f"channels.{name}", "expected one channel or more, got an empty list; add one, or leave it out"))
            for channel in channels:
                if channel in owners:
                    what = f"expected each channel once, got {channel} again ({owners[channel]} has it)"
                    faults.append((f"channels.{name}", f"{what}; give the channel that measures {name}"))
                owners.setdefault(channel, name)
        refuse(faults)
        return self


class Pad(Model):
    """A pad. Its frame's z axis points out of the skin."""

    type: str = Field(description="its design, a key of pad_types")
    link: str = Field(default="world", description="what it sits on: world, or ROBOT/LINK")
    position: Vector3 = Field(description="x, y, z in the frame of the link [m]")
    rpy: Angles3 = Field(default=(0.0, 0.0, 0.0), description="roll, pitch, yaw in the frame of the link [rad]")
    backed: bool = Field(
        default=False, description="whether the link is grounded metal behind it, which its field model includes"
    )
    calibration: dict[Name, Law] = Field(
        default={}, description="measured laws by electrode, written by `penumbra skin calibrate`"
    )
    boards: tuple[SensingBoard, ...] = Field(default=(), description="the sensing boards that read it")

    @cached_property
    def T_link_pad(self) -> rigid.Array:
        return rigid.from_rpy(self.position, self.rpy)
