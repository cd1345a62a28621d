"""Elements of models that several features share."""

_BOB = '<geom type="sphere" size=".05" pos="0 .05 -.1"/></body>'
BALL = '<body name="pendulum" pos="1 0 .3"><joint name="ball" type="ball" {}/>' + _BOB
FREE = '<body name="free" pos="2 0 .06"><joint name="free" type="free" {}/><geom type="box" size=".05 .04 .03"/></body>'
HUNG = '<body name="pendulum" pos="1 0 1"><joint name="ball" type="ball"/>' + _BOB
FIXED = '<fixed name="fixed" {}><joint joint="hinge" coef="1"/><joint joint="knee" coef="-.7"/></fixed>'
BRANCHES = '<fixed name="branches" {}><joint joint="arm" coef="1"/><joint joint="knee" coef="-.7"/></fixed>'
SPATIAL = '<spatial name="spatial" {}><site site="back"/><site site="tip"/></spatial>'
ACROSS = '<spatial name="across" {}><site site="hand"/><site site="tip"/></spatial>'
WRAP = """<spatial name="wrap" {}><site site="hand"/><geom geom="drum"/><site site="tip"/></spatial>"""
DRUM = '<geom name="drum" type="cylinder" size=".03 .1" pos="0 0 .07" euler="90 0 0" contype="0" conaffinity="0"/>'
PULLEY = """<spatial name="pulley" {}><site site="back"/><site site="tip"/><pulley divisor="2"/>
<site site="hand"/><site site="back"/></spatial>"""
STATIC = '<site name="one" pos="1 0 1"/><site name="two" pos="1 1 1"/>'
BETWEEN = '<spatial name="static" {}><site site="one"/><site site="two"/></spatial>'
MUSCLE = ".75 1.05 10 200 .5 1.6 1.5 1.3 1.2"
GENERAL = '<general ctrlrange="-1 1" {}/>'
SPHERE = {"torso": 'type="sphere" size=".05"'}
MOCAP = '<body name="mocap" mocap="true" {}><geom type="sphere" size=".08" {}/></body>'


def flag(name: str, value: str = "disable") -> dict[str, str]:
    """Slots of a flag."""
    return {"flag": f'{name}="{value}"'}
