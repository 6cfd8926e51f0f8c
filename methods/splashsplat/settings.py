"""Settings of SplashSplat.

What presets set is in presets.py. The paper's ablations are `variant` and, with two children, `separation_weight=0`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from splashbench.harness.contract import MethodConfig
from splashbench.observe.signed_distance import SignedDistanceMethod

from .appearance.decoder import DecoderSettings, ScaleResidual
from .appearance.first_look import LEAST_FEATURES, LEAST_HIDDEN
from .appearance.fit_settings import FitSettings
from .appearance.fitting import Composition
from .appearance.losses import LossWeights
from .appearance.targets import SilhouetteNorm
from .carriers.between import BetweenFrames
from .carriers.resampling import ShellSettings
from .carriers.tracking import CarrierSettings, TrackingVariant
from .fields.observations import FieldSettings
from .motion.observed_frames import MotionSettings
from .motion.velocity import VelocitySettings
from .presets import PRESETS

if TYPE_CHECKING:
    from ..scaffold_gs import BackgroundSettings


#: Whether liquid shows what is behind it; "measured" is settled before a fit (course.py).
Transmission = Literal["measured", "always", "never"]

# Share of the iterations, the last ones, in which it is measured what may be stored how coarsely.
_MEASURED = 0.2

#: Of the method; raised when a change alters figures, so that no study takes over runs from before.
VERSION = "37"


class SplashSplatConfig(MethodConfig):
    """Settings of SplashSplat. Lengths are in transport voxels; *_cells counts cells along the longest side."""

    # Observation fields
    #: cells of the visual hull's grid, at most
    hull_cells: int = Field(300, ge=16, le=512)
    #: edge of a hull voxel in pixels of the photographs, at the least: grids have fewer cells than `hull_cells`,
    #: `transport_cells` and `control_cells` where that many do; 0 for as many always
    voxel_pixels: float = Field(0.6, ge=0, le=16)
    #: the same in a transparent container, whose liquid is seen through its sides
    clear_voxel_pixels: float = Field(0.8, ge=0, le=16)
    #: edge of a hull voxel by the smallest length that the scene's cameras can show, as measured before the fit, where
    #: that is more than `voxel_pixels`; in place of `clear_voxel_pixels`
    observable: bool = False
    #: that edge, in this length: two samples of it and a little
    observable_share: PositiveFloat = Field(0.45, le=4)
    #: hull cells along the longest side that `voxel_pixels` and `clear_voxel_pixels` leave at least
    fewest_cells: int = Field(128, ge=16, le=512)
    #: cells of the grid of motion and carriers, at most
    transport_cells: int = Field(150, ge=16, le=256)
    #: cells of the grid that the velocity is fitted on, at most
    control_cells: int = Field(38, ge=4, le=128)
    #: control cells are "cubes", `control_cells` of them along the longest side, or along every one of the "sides" of
    #: the box, as the paper's 24^3
    control_grid: Literal["cubes", "sides"] = "cubes"
    #: how phi_t is computed: straight from the "silhouette", or by "carve" as in the paper
    signed_distance: SignedDistanceMethod = "silhouette"
    #: use the container's mesh, where the scene has one: what it hides, and where its walls are
    container: bool = True
    #: without a mesh: the upright vessel that fills the container masks, where the scene has them
    container_masks: bool = True
    #: without mesh and container masks: the upright vessel that the footage shows where the liquid is
    container_footage: bool = True
    #: liquid is cut by pixels where the near wall of an opaque container hides it (needs gravity, or a container in
    #: masks or footage)
    cut_at_rim: bool = True
    #: the box of the grids holds every frame's hull, or else the hull of all masks together; where failed masks are
    #: looked for, always the first
    tight_bounds: bool = True
    #: look for masks that miss much of the liquid, and replace them
    detect_failed_masks: bool = True
    #: replace empty masks where other views see liquid; in the paper they say that there is none
    replace_empty_masks: bool = True
    #: look for clocks, cameras and exposures that are other than told, in the footage itself, and go by what is found
    self_calibration: bool = True
    #: model nothing anew in timesteps whose photographs and masks are those of the one before
    repeats: bool = True
    #: carve, and compare photographs, at each camera's own times, where the scene has them
    camera_times: bool = True
    #: level the liquid that rests in the container (needs gravity and the mesh, or a container in masks or footage)
    pool: bool = True
    # Velocity
    #: free fall for the jet (needs the direction of gravity, or a container in masks or footage; and the metric scale,
    #: or that it is filmed how the jet begins or ends)
    ballistic: bool = True
    #: no motion where the level set's leads farther away from the observations than none
    gate_motion: bool = True
    #: steps of the velocity's fit between two frames; 0 for no motion
    velocity_steps: int = Field(15, ge=0)
    #: the fit of a step starts from the motion of the one before, not from none
    velocity_carry_on: bool = True
    #: share of the Gauss-Newton displacement that a step takes
    velocity_step_size: PositiveFloat = 0.45
    #: how far from the surface the velocity is fitted, in transport voxels
    velocity_band: PositiveFloat = 4.0
    #: width of the Gaussian that smooths the velocity; 0 for none
    velocity_smoothing: float = Field(0.6, ge=0)
    #: what is smoothed: each step's "update", or the whole "field" as in the paper
    velocity_smooth: Literal["update", "field"] = "update"
    #: voxels of which grid `velocity_smoothing` is in: the "control" grid's cells, or "transport" voxels
    velocity_smoothing_unit: Literal["control", "transport"] = "control"
    #: share of its divergence-free projection that the velocity takes on
    projection_blend: float = Field(0.35, ge=0, le=1)
    #: no velocity is beyond this, in transport voxels per frame
    velocity_limit: PositiveFloat = 8.0
    # Carriers
    #: "full", or one of the paper's ablations "no_resampling", "per_frame" and "flip"; the last needs gravity, the
    #: metric scale and the frames' times in scene.json
    variant: TrackingVariant = "full"
    #: how far, at most, a carrier outside the hull is moved towards it, in transport voxels
    correction: PositiveFloat = 1.0
    #: carriers farther outside the surface than this are dropped
    kill_outside: PositiveFloat = 0.5
    #: carriers deeper than this, which is negative, are dropped; None for none
    kill_inside: float | None = Field(-16.0, lt=0)
    #: carriers of a cell, at most, the oldest ones; None for no limit
    cell_capacity: PositiveInt | None = 8
    #: frames that a carrier lasts on average; None for as long as it stays in the liquid
    lifetime: PositiveInt | None = 4
    #: how far below the surface carriers are born
    shell_depth: PositiveFloat = 12.0
    #: no more than this in a transparent container: views see the liquid's sides there, and its surface is not deep in
    #: the hull; as much less far are carriers seen through liquid
    clear_shell_depth: PositiveFloat = 6.0
    #: how far beyond the surface carriers are born, too: coarse grids miss what is thinner than a voxel
    shell_outside: float = Field(0, ge=0, le=0.5)
    #: how far from the surface a carrier is born for a pixel of a mask that no liquid covers; 0 for none
    coverage_reach: float = Field(4.0, ge=0)
    #: carriers that a cell is filled up to, at the least
    min_per_cell: PositiveInt = 2
    #: carriers that a cell near the surface is filled up to, at the most, where it is curved
    max_per_cell: PositiveInt = 6
    #: carriers that a cell deeper than 3 voxels is filled up to; None for as many as elsewhere
    interior_per_cell: PositiveInt | None = 1
    #: no carriers where no training view can see them
    visible_only: bool = True
    # Decoder
    #: learned features of a carrier
    feature_size: PositiveInt = 16
    #: hidden units of the colour head
    color_width: PositiveInt = 32
    #: Gaussians of a carrier
    children: int = Field(1, ge=1, le=6)
    #: extent of a Gaussian at the start, in transport voxels
    base_scale: PositiveFloat = 0.5
    #: how far a Gaussian may move off its carrier, in extents of the carrier
    offset_bound: PositiveFloat = 3.0
    #: depth below the surface at which opacity has faded to half, in transport voxels
    opacity_band: PositiveFloat = 20.0
    #: the logit of every Gaussian's opacity at the start
    opacity_bias: float = -1.0
    #: each Gaussian shows a share of what lies behind the liquid: "always", "never", or as is "measured" in photographs
    #: and clean plates; only where the liquid is drawn "over" the background (`composition`)
    transmission: Transmission = "measured"
    #: what stands in the exponent of a Gaussian's size: its head's answer "bounded" to within 2 and -2, or as it is
    scale_residual: ScaleResidual = "bounded"
    # Optimisation
    #: steps of the appearance's fit, at most
    iterations: int = Field(4000, ge=0)
    #: share of them, the first ones, made on coarse grids, whose carriers the fine ones begin with; 0 for none. Only
    #: where learning rates fall from the start on, the background is not fitted first (`plates_share`), and no budget
    #: is to be kept
    coarse_grids_share: float = Field(0.2, ge=0, le=0.5)
    #: pixels along the longest side up to which photographs are small enough for that: larger ones show what it loses
    coarse_grids_side: PositiveInt = 320
    #: learning rate of carriers' own features
    learning_rate_features: PositiveFloat = 0.06
    #: learning rate of the features that carriers of a cell share
    learning_rate_cells: PositiveFloat = 0.02
    #: learning rate of the decoder's heads
    learning_rate_heads: PositiveFloat = 0.015
    #: learning rate of carriers' sizes
    learning_rate_scales: PositiveFloat = 1e-2
    #: carriers born in one cell share a part of their features: its size in voxels and in frames, for each part
    feature_cells: tuple[PositiveFloat, ...] = Field((4.0, 16.0), max_length=6)
    #: and one with all carriers ever born in a cell of so many voxels; 0 for none
    still_cell: float = Field(2.0, ge=0)
    #: learning rates fall along a half cosine, where the schedule is fixed
    anneal: bool = True
    #: share of the photographs by whose loss the fit stops before `iterations`, and which it leaves out; 0 never stops
    validation_share: float = Field(0.0, ge=0, le=0.1)
    #: gain in withheld photographs below which learning rates fall and the fit ends; see `validation_share`
    stop_gain: float = Field(0.01, ge=0, lt=1)
    #: PSNR of withheld photographs, in dB, that iterations have to gain for each doubling of the time, so that there
    #: are more of them; 0 for `stop_gain`
    price: float = Field(0.0, ge=0, le=10)
    #: the SSIM term enters every so many iterations, weighted up by as much
    ssim_every: PositiveInt = 1
    #: what the silhouette term is averaged over: the "image", the "window" around all masks of the view, or the "mask"
    silhouette_norm: SilhouetteNorm = "window"
    #: between frames the carriers of "both" are shown, or those of the one before, moved "forward" as in the paper
    between_frames: BetweenFrames = "both"
    #: the liquid is drawn "over" an image of the background, or "together" with the background's Gaussians, by depth
    composition: Composition = "over"
    #: weight of the loss: colours within the mask
    foreground_weight: float = Field(0.5, ge=0)
    #: weight of the loss: image gradients within the mask
    gradient_weight: float = Field(0.1, ge=0)
    #: weight of the loss: SSIM
    ssim_weight: float = Field(0.2, ge=0)
    #: weight of the loss: opacity against the mask
    silhouette_weight: float = Field(0.4, ge=0)
    #: weight of the loss: sizes of Gaussians, the mean trace of their covariances
    covariance_weight: float = Field(0.01, ge=0)
    #: weight of the loss: children of a carrier apart from one another
    separation_weight: float = Field(0.1, ge=0)
    #: weight of the loss: colours of a cell's carriers apart from their mean
    color_weight: float = Field(1.0, ge=0)
    #: weight of the loss: what photographs show beside the liquid, where there is `glass`
    beside_weight: float = Field(0.4, ge=0)
    #: Gaussians of a transparent container before the liquid, to begin with, where images have 240 pixels along the
    #: longer side; more in proportion where they have more; 0 for none
    glass: int = Field(4000, ge=0, le=100_000)
    #: carriers whose learned opacity falls below this are dropped, eight times during the fit and at its end; 0 keeps
    #: all
    prune_opacity: float = Field(0.01, ge=0, lt=1)
    #: carriers that together make up no more than this share of a photograph are not fitted to it; 0 fits all
    idle_share: float = Field(0.02, ge=0, le=0.2)
    #: such carriers are looked for sooner as well: after another tenth of the iterations
    idle_early: bool = False
    #: the same in a transparent container; violent liquid in an opaque one loses by it, as opacities say little so soon
    clear_idle_early: bool = True
    #: carriers begin with the colours in which the photographs show them, or else at random as in the paper
    first_look: bool = True
    #: share of the iterations, the first ones, that see photographs at half their size; 0 for none
    coarse_share: float = Field(0.95, ge=0, le=1)
    #: share of the iterations, the first ones of these, that see them at a quarter
    coarsest_share: float = Field(0.4, ge=0, le=1)
    #: pixels along the longest side beyond which photographs are large enough for that
    coarse_side: PositiveInt = 1500
    #: share of the iterations on fine grids, the first ones, that have the footage's clean plates behind the liquid, as
    #: the background is fitted afterwards; 0 fits it first. Not where it is drawn "together" with the liquid; where
    #: there are coarse grids and the liquid is transparent, the background comes before these
    plates_share: float = Field(0.2, ge=0, le=1)
    #: by how much rounding what is stored may raise the squared error in training photographs, as a share of it; 0
    #: stores in steps of a twentieth of each value's spread
    storage_tolerance: float = Field(0.05, ge=0, le=1)
    # Background, fitted by scaffold_gs: its preset
    #: preset of scaffold_gs, by which the background is fitted
    background_preset: Literal["best", "paper", "brief", "quick"] = "brief"
    #: hull cells, at the most, of a draft that is made first where states of the fit are taken (`run --checkpoints`);
    #: 0 for none
    draft_cells: int = Field(140, ge=0, le=512)

    renamed: ClassVar[Mapping[str, str]] = {
        "distance": "signed_distance",
        "detect_failures": "detect_failed_masks",
        "learning_rate_shared": "learning_rate_cells",
        "shared_cells": "feature_cells",
        "withheld_share": "validation_share",
        "colour_weight": "color_weight",
    }
    #: the fourth rung is "best"; pixels limit the grids of larger ones (`voxel_pixels`)
    capacity: ClassVar[Mapping[str, Sequence[Any]]] = {
        "hull_cells": (96, 144, 208, 300, 416),
        "transport_cells": (48, 72, 104, 150, 208),
        "control_cells": (12, 18, 26, 38, 52),
        "feature_size": (8, 8, 16, 16, 32),
        "iterations": (500, 1000, 2000, 4000, 8000),
    }
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS

    @model_validator(mode="after")
    def _room_for_the_first_look(self) -> SplashSplatConfig:
        if self.first_look and (self.feature_size < LEAST_FEATURES or self.color_width < LEAST_HIDDEN):
            raise ValueError(
                f"first_look needs a feature_size of {LEAST_FEATURES} and a color_width of {LEAST_HIDDEN} at least; "
                "set first_look=false"
            )
        return self

    @model_validator(mode="after")
    def _transmission_over_a_background(self) -> SplashSplatConfig:
        if self.transmission == "always" and self.composition == "together":
            raise ValueError('transmission="always" needs composition="over"')
        return self

    @property
    def control_factor(self) -> int:
        """Transport voxels per control cell."""
        return max(1, round(self.transport_cells / self.control_cells))

    @property
    def coarse_iterations(self) -> int:
        """Of the iterations, the first ones, those that are made on coarse grids."""
        return round(self.coarse_grids_share * self.iterations)

    @property
    def background(self) -> BackgroundSettings:
        from ..scaffold_gs import BackgroundSettings

        return BackgroundSettings.model_validate(BackgroundSettings.presets[self.background_preset])

    @property
    def fields(self) -> FieldSettings:
        return FieldSettings(
            hull_cells=self.hull_cells,
            transport_cells=self.transport_cells,
            voxel_pixels=self.voxel_pixels,
            clear_voxel_pixels=self.clear_voxel_pixels,
            fewest_cells=self.fewest_cells,
            signed_distance=self.signed_distance,
            container=self.container,
            container_masks=self.container_masks,
            container_footage=self.container_footage,
            cut_at_rim=self.cut_at_rim,
            detect_failed_masks=self.detect_failed_masks,
            replace_empty_masks=self.replace_empty_masks,
            camera_times=self.camera_times,
            pool=self.pool,
            ballistic=self.ballistic,
            tight_bounds=self.tight_bounds,
            repeats=self.repeats,
            observable=self.observable,
            observable_share=self.observable_share,
        )

    @property
    def motion(self) -> MotionSettings:
        velocity = VelocitySettings(
            steps=self.velocity_steps,
            step_size=self.velocity_step_size,
            band=self.velocity_band,
            smoothing=self.velocity_smoothing,
            smooth=self.velocity_smooth,
            smoothing_unit=self.velocity_smoothing_unit,
            projection_blend=self.projection_blend,
            limit=self.velocity_limit,
        )
        return MotionSettings(
            self.control_factor,
            self.gate_motion,
            self.variant != "per_frame",
            velocity,
            self.control_cells if self.control_grid == "sides" else None,
            self.velocity_carry_on,
        )

    def in_transparent_container(self) -> SplashSplatConfig:
        """The settings where the liquid is in a transparent container."""
        return self.model_copy(
            update={
                "shell_depth": min(self.shell_depth, self.clear_shell_depth),
                "idle_early": self.idle_early or self.clear_idle_early,
            }
        )

    @property
    def carriers(self) -> CarrierSettings:
        return CarrierSettings(
            variant=self.variant,
            correction=self.correction,
            kill_outside=self.kill_outside,
            kill_inside=self.kill_inside,
            cell_capacity=self.cell_capacity,
            lifetime=self.lifetime,
            shell=ShellSettings(
                depth=self.shell_depth,
                outside=self.shell_outside,
                min_per_cell=self.min_per_cell,
                max_per_cell=max(self.min_per_cell, self.max_per_cell),
                interior_per_cell=self.interior_per_cell,
            ),
        )

    @property
    def carried(self) -> bool:
        """Whether the fitted velocity is what moves the carriers; what moves those of the other variants is not u_t."""
        return self.variant in ("full", "no_resampling")

    @property
    def decoder(self) -> DecoderSettings:
        return DecoderSettings(
            feature_size=self.feature_size,
            color_width=self.color_width,
            children=self.children,
            offset_bound=self.offset_bound,
            opacity_band=self.opacity_band,
            opacity_bias=self.opacity_bias,
            scale_residual=self.scale_residual,
            transmission=self.transmission == "always",
        )

    @property
    def optimisation(self) -> FitSettings:
        return FitSettings(
            iterations=self.iterations,
            learning_rate_features=self.learning_rate_features,
            learning_rate_cells=self.learning_rate_cells,
            feature_cells=self.feature_cells,
            still_cell=self.still_cell,
            learning_rate_heads=self.learning_rate_heads,
            learning_rate_scales=self.learning_rate_scales,
            anneal=self.anneal,
            validation_share=self.validation_share,
            stop_gain=self.stop_gain,
            price=self.price,
            ssim_every=self.ssim_every,
            base_scale=self.base_scale,
            prune_opacity=self.prune_opacity,
            idle_share=self.idle_share,
            idle_early=self.idle_early,
            coarse_share=self.coarse_share,
            coarsest_share=self.coarsest_share,
            plates_share=self.plates_share,
            measured_share=_MEASURED if self.storage_tolerance > 0 else 0,
            weights=LossWeights(
                foreground=self.foreground_weight,
                gradient=self.gradient_weight,
                ssim=self.ssim_weight,
                silhouette=self.silhouette_weight,
                covariance=self.covariance_weight,
                separation=self.separation_weight,
                color=self.color_weight,
                beside=self.beside_weight,
            ),
        )
