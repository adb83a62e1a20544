"""The shape of a definition file: strict, typed tables in which each number has a value, a unit and a source."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StrictBool

from cirl_marl.network.elements import ControlKind, Law, NetZero, Observe, Reward, Role, ServiceQuantity, Solver
from cirl_marl.network.validate import IDENTIFIER

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Source = Annotated[str, Field(min_length=1, description="where the number comes from")]
Identifier = Annotated[str, Field(pattern=IDENTIFIER)]


class Table(BaseModel):
    """A TOML table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class Quantity(Table):
    """A number with its unit and source."""

    value: Number
    unit: str = Field(description="pint unit, such as 'kt', '1/day', 't/day'; '1' if dimensionless")
    source: Source


class Range(Table):
    """An interval from which initial stocks are drawn uniformly."""

    low: Number
    high: Number
    unit: str
    source: Source


class Series(Table):
    """A step function of time: ``values[i]`` holds from ``times[i]`` on."""

    times: list[Number] = Field(description="starts of the steps, beginning with 0")
    time_unit: str
    values: list[Number]
    unit: str
    source: Source


class Batches(Table):
    """Discrete masses: ``masses[i]`` leaves the donor at ``times[i]``, at the start of a control interval."""

    times: list[Number]
    time_unit: str
    masses: list[Number]
    unit: str
    source: Source


class ControlTable(Table):
    """What the agent of this compartment sets."""

    kind: ControlKind = Field(
        description="'rate': a factor on the flow(s); 'flow': the flow itself; 'input': of the model"
    )
    low: Number = Field(description="value at action -1")
    neutral: Number = Field(description="value while nobody acts")
    high: Number = Field(description="value at action +1")
    unit: str
    source: Source


class InnerRange(Table):
    """Initial range of an inner state, in the unit that its name carries."""

    low: Number
    high: Number
    source: Source


class ModelTable(Table):
    """Inner physics of a compartment."""

    kind: str = Field(description="name of a compartment model")
    form: str | None = Field(None, description="form of the equations, such as 'published' or 'sound'")
    parameters: dict[str, StrictBool | Number] = Field(
        {}, description="parameters that differ from the model's own, by name"
    )
    source: Source
    initial: dict[str, InnerRange] = Field(
        {}, description="initial range of each inner state that the model does not draw"
    )
    reward_scale: Quantity | None = Field(None, description="the model's reward is divided by it, unit '1'; default 1")


class NodeTable(Table):
    """A compartment that stores material."""

    title: str = ""
    model: ModelTable | None = None
    role: Role
    initial: Range
    set_point: Quantity | None = None
    scale: Quantity | None = Field(None, description="reference stock; default: scales.stock")
    control: ControlTable | None = None


class ArcTable(Table):
    """A compartment that moves material."""

    title: str = ""
    model: ModelTable | None = None
    by: str = Field("", description="compartment whose model gives the flow or releases the batches")
    port: str = Field("", description="port of that model (batch law)")
    batches: Batches | None = Field(None, description="schedule of the batch law; instead of 'by'")
    delay: Quantity | None = Field(None, description="transit time of batches, if no vehicle's model decides")
    from_: str = Field(alias="from", description="id of the node that gives")
    to: str = Field(description="id of the node that receives")
    law: Law
    rate: Quantity | None = Field(
        None, description="a, 1/time (donor, recipient), mass/time per unit of output, mass per unit released (batch)"
    )
    flow: Quantity | None = Field(None, description="constant flow of the exogenous law")
    series: Series | None = Field(None, description="time series of the exogenous law")
    set_point: Quantity | None = None
    scale: Quantity | None = Field(
        None, description="reference flow, default: scales.flow; of a batch arc reference mass, default: scales.stock"
    )
    pollutant: StrictBool = Field(True, description="whether what enters an environment here is a pollutant")
    control: ControlTable | None = None


class ServiceTable(Table):
    """A stock or flow to be kept within a band."""

    title: str = ""
    provider: str = Field(description="compartment at which the service is measured")
    quantity: ServiceQuantity
    measure: str = Field("", description="what the provider's model measures, for quantity 'measure'")
    low: Quantity
    high: Quantity | None = None
    weight: Quantity = Field(description="factor of the shortfall in the local rewards")
    owed_by: list[str] = Field(
        [], description="compartments whose local reward bears the shortfall; default: the provider"
    )


class UnitsTable(Table):
    """Units in which the network is simulated and reported."""

    mass: str
    time: str


class EpisodeTable(Table):
    """Time and solver."""

    control_interval: Quantity
    horizon: Quantity = Field(description="decisions per episode, unit '1'")
    solver: Solver = "exact"
    solver_step: Quantity | None = None


class ScalesTable(Table):
    """Reference stock and flow of compartments that state none of their own."""

    stock: Quantity
    flow: Quantity


class ObjectiveTable(Table):
    """Circularity and rewards."""

    reference_interval: Quantity = Field(description="the interval Δ of λ = -(m_fb + Δ·ṁ_fc)")
    net_zero: NetZero
    reward: Reward
    circularity_scale: Quantity
    circularity_weight: Quantity
    tracked: list[str] = Field(
        [], description="compartments whose set-point counts in local rewards; default: all that have one"
    )
    criticality: Quantity | None = Field(
        None, description="criticality of the material, unit '1', for its weighted KPI"
    )


class ObservationTable(Table):
    """What agents see by default."""

    mode: Observe
    nodes: list[str] = Field([], description="observed nodes of mode 'stocks', in order")


class NetworkTable(Table):
    """A material network."""

    name: Identifier
    title: str
    material: str
    references: list[str] = []
    units: UnitsTable
    episode: EpisodeTable
    scales: ScalesTable
    objective: ObjectiveTable
    observation: ObservationTable
    agents: list[str] = Field([], description="who acts; default: every compartment with a control")
    nodes: dict[Identifier, NodeTable]
    arcs: dict[Identifier, ArcTable]
    services: dict[Identifier, ServiceTable] = {}
    scenarios: dict[Identifier, dict[str, Any]] = Field(
        {},
        description="tables that replace those of the default scenario, key by key, after those named in 'without', "
        "such as 'nodes.digester.model', are left out",
    )


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of definition files, with which editors complete and check them.

    A scenario may give any part of a network, so in its branch nothing is required.
    """
    schema = NetworkTable.model_json_schema(by_alias=True)
    definitions = schema["$defs"]

    def part(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: f"{item}Part" if key == "$ref" and item.split("/")[-1] in tables else part(item)
                for key, item in value.items()
                if not (key == "required" and isinstance(item, list))
            }
        return [part(item) for item in value] if isinstance(value, list) else value

    tables = [name for name, body in definitions.items() if body.get("type") == "object"]
    parts = {f"{name}Part": part(definitions[name]) for name in tables}
    properties = {k: v for k, v in schema["properties"].items() if k not in ("scenarios", "name")}
    without = {"type": "array", "items": {"type": "string"}, "description": "what to leave out first, as dotted paths"}
    parts["Scenario"] = {
        "type": "object",
        "additionalProperties": False,
        "properties": {"without": without, **part(properties)},
    }
    definitions.update(parts)
    scenarios = schema["properties"]["scenarios"]["patternProperties"]
    scenarios.update({pattern: {"$ref": "#/$defs/Scenario"} for pattern in scenarios})
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return schema
