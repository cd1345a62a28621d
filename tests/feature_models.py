"""Small models with one feature of MuJoCo each, for comparing engines. Two features combine into one model."""

import re
from collections.abc import Sequence

import mujoco
from features import FEATURES

Features = tuple[str, ...]
"""Names of features."""

SLOTS = (
    *("compiler", "option", "flag", "size", "custom", "asset", "floor", "body", "torso_parts", "slide", "lift"),
    *(
        "hinge",
        "torso",
        "knee",
        "shin_body",
        "shin",
        "arm_joint",
        "arm",
        "world",
        "contact",
        "tendon",
        "equality",
        "actuator",
    ),
    *("motor", "sensor"),
)
"""Places in the model: attributes of an element, or further elements."""

WORLD = """
<mujoco>
  <compiler {compiler}/>
  <option timestep="0.004" {option}><flag {flag}/></option>
  <size {size}/>
  <custom>{custom}</custom>
  <default>{defaults}</default>
  {exhibits}
</mujoco>
"""
EXHIBIT = """
<asset>{asset}</asset>
<worldbody><frame {frame}>
  <geom name="floor" {floor}/>
  <body name="torso" pos="0 0 .045" {body}>
    {torso_parts}
    <joint name="slide" type="slide" axis="1 0 0" {slide}/>
    <joint name="lift" type="slide" axis="0 0 1" {lift}/>
    <joint name="hinge" axis="0 1 0" {hinge}/>
    <geom name="torso" {torso}/>
    <site name="back" pos="0 0 .1"/>
    <body name="shin" pos=".3 0 0" {shin_body}>
      <joint name="knee" axis="0 1 0" {knee}/>
      <geom name="shin" type="capsule" size=".04" fromto="0 0 0 .3 0 .05" {shin}/>
      <site name="tip" pos=".3 0 .05"/>
    </body>
    <body name="arm_body" pos="-.2 0 .1">
      <joint name="arm" axis="0 1 .2" {arm_joint}/>
      <geom name="arm" type="sphere" size=".04" pos="-.1 0 .03" {arm}/>
      <site name="hand" pos="-.1 .02 .03"/>
    </body>
  </body>
  {world}
</frame></worldbody>
<contact>{contact}</contact>
<tendon>{tendon}</tendon>
<equality>{equality}</equality>
<actuator><motor name="m" joint="knee" gear="2" ctrlrange="-1 1" {motor}/>{actuator}</actuator>
<sensor>{sensor}</sensor>
"""
_OWN = {"floor": 'type="plane" size="5 5 .1"', "torso": 'type="capsule" size=".05" fromto="-.15 0 0 .15 0 0"'}
"""Attributes of a slot unless a feature sets the same ones."""
_REFERENCE = re.compile(
    r"\b(name|joint|joint1|joint2|jointinparent|site|refsite|sidesite|cranksite|slidersite|geom|geom1|geom2|body|body1|"
    r'body2|tendon|tendon1|tendon2|mesh|hfield)="(?!world)([^"]+)"'
)


def slots_of(features: Features, parts: dict[str, str]) -> dict[str, str]:
    """Text of each slot, for several features and further parts."""
    slots = dict.fromkeys(SLOTS, "")
    for slot, text in [*(item for name in features for item in FEATURES[name].items()), *parts.items()]:
        if text not in slots[slot]:
            slots[slot] = f"{slots[slot]} {text}".strip()
    for slot, text in _OWN.items():
        if "type=" not in slots[slot]:
            slots[slot] = f"{text} {slots[slot]}"
    return slots


def load(*features: str, **parts: str) -> mujoco.MjModel:
    """The model with several features, and further parts."""
    slots = slots_of(features, parts)
    exhibit = EXHIBIT.format(**slots, frame="")
    return mujoco.MjModel.from_xml_string(WORLD.format(**slots, defaults="", exhibits=exhibit))


def is_local(features: Features) -> bool:
    """Whether features concern their own bodies only, so that models with others of them can share one world."""
    return not any(
        {"option", "flag", "compiler", "custom", "size"} & {*FEATURES[name]}
        or "contype" in FEATURES[name].get("shin", "")
        for name in features
    )


def gallery(exhibits: Sequence[Features], settings: Features, **parts: str) -> mujoco.MjModel:
    """A model of many models that do not touch each other.

    Args:
        exhibits: the features of each; at most 31.
        settings: features of the world: options and flags.
        parts: further parts of the world.
    """
    defaults, texts = "", ""
    for i, features in enumerate(exhibits):
        defaults += f'<default class="{i}"><geom contype="{1 << i}" conaffinity="{1 << i}"/></default>'
        text = EXHIBIT.format(**slots_of(features, {}), frame=f'pos="0 {5 * i} 0" childclass="{i}"')
        texts += _REFERENCE.sub(rf'\1="{i}:\2"', text)
    return mujoco.MjModel.from_xml_string(WORLD.format(**slots_of(settings, parts), defaults=defaults, exhibits=texts))


def exhibit_of_dofs(model: mujoco.MjModel) -> list[int]:
    """The exhibit to which each degree of freedom of a gallery belongs."""
    bodies = (model.body(model.dof_bodyid[dof]).name for dof in range(model.nv))
    return [int(name.partition(":")[0]) for name in bodies]
