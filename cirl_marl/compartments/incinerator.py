"""The incinerator: a wastebed on a grate, and the freeboard in which its gases burn out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from cirl_marl.network.compartment_model import ContinuousModel, OutflowModel, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, Quantity, Share, Word, frozen_record
from cirl_marl.network.rowsum import Floats

# The registered environment: one step is 5·10⁻⁵ min. Horizon 100 and T_g(0) ~ U[900, 1100] °C are inferred: from the
# released 20 °C a step costs 9.6·10⁵, while the paper's whole episodes cost 3.2·10⁵ to 3.8·10⁵.

KELVIN = 273.15
Temperature = partial(Quantity, low=1.0 - KELVIN)
_Form = Literal["published", "energy_balance", "sound"]


class Flows(NamedTuple):
    """Flows and conversions, kg/min, each of shape (B,) or a number."""

    feed: Floats | float = 100.0
    ash: Floats | float = 10.0
    waste_consumed: Floats | float = 70.0
    char_made: Floats | float = 6.0
    char_burnt: Floats | float = 3.0
    char_out: Floats | float = 2.0
    gas_made: Floats | float = 1.0
    to_freeboard: Floats | float = 2.0
    flue: Floats | float = 2.0


PUBLISHED_FLOWS = Flows()
"""F_in, F_out, R_w, P, R_c, F_c, R_g, F_w, F_g. [published] They leave 3 kg/min of gas in the freeboard for ever."""


@frozen_record
class Incinerator(ContinuousModel, OutflowModel):
    """Masses and temperatures of wastebed (waste M, char M_c, gas M_w, T_w) and freeboard (gas M_f, T_g).

    Ṁ = F_in − F_out − R_w, Ṁ_c = P − R_c − F_c, Ṁ_w = F_aI + R_g − F_w, Ṁ_f = F_w + F_aII − F_g,
    (c_w M + c_c M_c + C_grate)Ṫ_w = bed power,
    (c_g M_f + C_free)Ṫ_g = F_w c_g(T_w − T_g) + F_aII c_g(T_a − T_g) + Q_g − Q_ext.
    The control is Q_ext, heat taken from the freeboard (negative: a burner). Reward: −(1000 − T_g)² after the step.

    ``published``: bed power F_in c_w **T_w** + F_aI c_g(T_a − T_w) + Q: the feed brings heat at the bed's own
    temperature and nothing takes it out, so T_w grows for ever (743 °C at 180 min); ``c_p_m`` is assigned 25, then 5,
    so C_grate = 5·500; all rates are constants, so masses grow for ever and R_g = 1 loses mass.
    ``energy_balance``: bed power F_in c_w(T_a − T_w) + F_aI c_g(T_a − T_w) + Q and C_grate = 25·500, the rest as
    published: 20.6 °C at 180 min (20.8 with the grate's 5). With Q = 0 no temperature leaves the range of what
    flows in.
    ``sound``: besides, rates follow what is there. F_out, R_w ∝ M and F_c, R_c ∝ M_c, equal to the published ones at
    the reference inventories; R ∝ θ = exp(T_A(1/T_ref − 1/T_w)); P = 6/70·R_w; gas leaves after a residence time;
    R_g = R_w − P + R_c, so mass is conserved; heat h·R_g, a share of it in the bed; bed and freeboard exchange
    U(T_g − T_w); and Q_ext ≤ U_rec(T_g − T_a), for nothing cools below ambient. A cold bed does not ignite: start it
    hot (M 2400, M_c 150, M_w 36, M_f 37.5 kg, T_w 300, T_g 1000 °C). Q_ext = 3.56·10⁵ kJ/min holds 1000 °C there while
    the bed is as warm; the plant comes to rest at 1000 °C, hours later, with 6.44·10⁵ kJ/min (11 MW).

    Source: published code of arXiv 2505.21536, "not taken from a real incinerator", after Magnanelli et al., Energy 209
    (2020) 118426; its only units are min and °C, kg and kJ are inferred. The reference trajectory is reproduced to the
    last digit from its second row on. Numbers of ``sound`` alone are chosen, at the scale of a 6 t/h plant.
    """

    kind: ClassVar[str] = "incinerator"
    state_names: ClassVar[tuple[str, ...]] = tuple(
        "waste_kg char_kg wastebed_degc wastebed_gas_kg freeboard_gas_kg freeboard_degc".split()
    )
    input_names: ClassVar[tuple[str, ...]] = ("heat_taken_kj_min",)
    input_unit: ClassVar[str] = "kJ/min"
    time_unit: ClassVar[str] = "min"
    reward_state: ClassVar[RewardState] = "after"

    form: Annotated[_Form, Word("which equations", of=get_args(_Form))] = "sound"
    feed_kg_min: Annotated[float, NotNegative("F_in unless ``derivative`` is given another [published]")] = 100.0
    air_bed_kg_min: Annotated[float, NotNegative("F_aI [published]")] = 5.0
    air_freeboard_kg_min: Annotated[float, NotNegative("F_aII [published]")] = 3.0
    ambient_degc: Annotated[float, Temperature("T_a of air and feed [published; of the feed inferred]")] = 20.0
    waste_heat_kj_kg_k: Annotated[float, NotNegative("c_w [published]")] = 1.0
    char_heat_kj_kg_k: Annotated[float, NotNegative("c_c [published]")] = 1.0
    gas_heat_kj_kg_k: Annotated[float, NotNegative("c_g [published]")] = 5.0
    grate_kg: Annotated[float, Positive("mass of the grate [published]")] = 500.0
    grate_heat_kj_kg_k: Annotated[
        float, Positive("c of the grate, 25; ``published`` uses the freeboard's [published]")
    ] = 25.0
    freeboard_kg: Annotated[float, Positive("mass of the freeboard's walls [published]")] = 120.0
    freeboard_heat_kj_kg_k: Annotated[float, Positive("c of the walls [published]")] = 5.0
    bed_heat_kj_min: Annotated[float, NotNegative("Q, constant rates only [published]")] = 100.0
    freeboard_heat_kj_min: Annotated[float, NotNegative("Q_g, constant rates only [published]")] = 450.0
    target_degc: Annotated[float, Temperature("set-point of T_g [published]")] = 1000.0
    waste_reference_kg: Annotated[
        float, Positive("M at which F_out = 10 and R_w = 70 [chosen: half an hour's throughput]")
    ] = 2400.0
    char_reference_kg: Annotated[float, Positive("M_c at which F_c = 2 and R_c = 3 [chosen: half an hour]")] = 150.0
    reference_degc: Annotated[float, Temperature("T_ref, where θ = 1 [chosen]")] = 300.0
    activation_k: Annotated[float, NotNegative("T_A [chosen]")] = 5000.0
    gas_residence_min: Annotated[float, Positive("of wastebed and freeboard gas [chosen]")] = 0.5
    combustion_kj_kg: Annotated[
        float, NotNegative("h, heat per kg turned to gas [chosen: lower heating value of municipal waste]")
    ] = 10_000.0
    bed_share: Annotated[float, Share("share of the heat released in the bed [chosen]")] = 0.05
    exchange_kj_min_k: Annotated[float, NotNegative("U between freeboard and bed [chosen]")] = 20.0
    recovery_kj_min_k: Annotated[float, NotNegative("U_rec of the heat recovery [chosen]")] = 1000.0

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """States for which the sound form holds; the published ones let masses grow, or shrink below nothing."""
        if self.form != "sound":
            return {}
        return {name: (0.0 if name.endswith("_kg") else -KELVIN + 1.0, math.inf) for name in self.state_names}

    def flows(self, state: Floats, feed_kg_min: Floats | float | None = None) -> Flows:
        """Return every flow and conversion, kg/min."""
        feed = self.feed_kg_min if feed_kg_min is None else feed_kg_min
        if self.form != "sound":
            return PUBLISHED_FLOWS._replace(feed=feed)
        waste, char, bed_degc, bed_gas, freeboard_gas, _ = state
        inverse = 1.0 / (self.reference_degc + KELVIN) - 1.0 / (bed_degc + KELVIN)
        faster = np.exp(self.activation_k * inverse)
        of_waste, of_char = waste / self.waste_reference_kg, char / self.char_reference_kg
        usual = PUBLISHED_FLOWS
        consumption, char_burnt = usual.waste_consumed * faster * of_waste, usual.char_burnt * faster * of_char
        char_made = usual.char_made / usual.waste_consumed * consumption
        return Flows(
            feed=feed,
            ash=usual.ash * of_waste,
            waste_consumed=consumption,
            char_made=char_made,
            char_burnt=char_burnt,
            char_out=usual.char_out * of_char,
            gas_made=consumption - char_made + char_burnt,
            to_freeboard=bed_gas / self.gas_residence_min,
            flue=freeboard_gas / self.gas_residence_min,
        )

    def derivative(self, state: Floats, inputs: Floats, *, feed_kg_min: Floats | float | None = None) -> Floats:
        """Return d(M, M_c, T_w, M_w, M_f, T_g)/dt per minute, shape (6, B); another feed is a number or shape (B,)."""
        flows = self.flows(state, feed_kg_min)
        bed_power, freeboard_power = self.powers(state, inputs, flows)
        bed_capacity, freeboard_capacity = self.capacities(state)
        like = np.zeros_like(state[0])
        return np.stack(
            [
                like + (flows.feed - flows.ash - flows.waste_consumed),
                like + (-flows.char_out + flows.char_made - flows.char_burnt),
                bed_power / bed_capacity,
                like + (self.air_bed_kg_min - flows.to_freeboard + flows.gas_made),
                like + (flows.to_freeboard - flows.flue + self.air_freeboard_kg_min),
                freeboard_power / freeboard_capacity,
            ]
        )

    def powers(self, state: Floats, inputs: Floats, flows: Flows) -> tuple[Floats, Floats]:
        """Return what heats wastebed and freeboard, kJ/min, each of shape (B,)."""
        bed, freeboard, recovery = state[2], state[5], inputs[0]
        gas, ambient = self.gas_heat_kj_kg_k, self.ambient_degc
        temperature_rise = bed if self.form == "published" else ambient - bed
        bed_power = flows.feed * self.waste_heat_kj_kg_k * temperature_rise + self.air_bed_kg_min * gas * (
            ambient - bed
        )
        freeboard_power = flows.to_freeboard * gas * (bed - freeboard)
        freeboard_power = freeboard_power + self.air_freeboard_kg_min * gas * (ambient - freeboard)
        if self.form != "sound":
            return bed_power + self.bed_heat_kj_min, freeboard_power + self.freeboard_heat_kj_min - recovery
        combustion = self.combustion_kj_kg * flows.gas_made
        exchange = self.exchange_kj_min_k * (freeboard - bed)
        recovery = np.minimum(recovery, self.recovery_kj_min_k * (freeboard - ambient))
        bed_power = bed_power + self.bed_share * combustion + exchange
        return bed_power, freeboard_power + (1.0 - self.bed_share) * combustion - exchange - recovery

    def capacities(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the heat capacities of wastebed and freeboard, kJ/K, each of shape (B,)."""
        grate = self.freeboard_heat_kj_kg_k if self.form == "published" else self.grate_heat_kj_kg_k
        bed = self.waste_heat_kj_kg_k * state[0] + self.char_heat_kj_kg_k * state[1] + grate * self.grate_kg
        free = self.gas_heat_kj_kg_k * state[4] + self.freeboard_heat_kj_kg_k * self.freeboard_kg
        return bed, free

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −(1000 − T_g)², K², shape (B,)."""
        cost: Floats = (self.target_degc - state[5]) ** 2
        return -cost

    def receive(self, state: Floats, mass_kg: Floats) -> Floats:
        """Return the state after ``mass_kg``, shape (B,), was tipped onto the wastebed at ambient temperature.

        Bed and grate keep their heat: (c_w M + c_c M_c + C_grate)(T_w − T_a) is the same before and after.
        """
        before, _ = self.capacities(state)
        after = state.copy()
        after[0] = state[0] + mass_kg
        share = before / self.capacities(after)[0]
        after[2] = self.ambient_degc + share * (state[2] - self.ambient_degc)
        return after

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the flue gas that leaves the freeboard, kg/min, shape (B,)."""
        flue: Floats = np.zeros_like(state[0]) + self.flows(state).flue
        return flue
