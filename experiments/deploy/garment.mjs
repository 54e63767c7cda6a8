// A character's garment in ONNX Runtime Web: one call a frame. `about` is the JSON that clothjax convert wrote.

export class Garment {
  constructor(ort, session, about) {
    Object.assign(this, { ort, session, about });
  }

  tensor(name, values) {
    return new this.ort.Tensor("float32", Float32Array.from(values), this.about.shapes[name]);
  }

  // The cloth's acceleration beside gravity in the frames to come, [3] m/s^2: only of a garment with forces.
  external = [0, 0, 0];

  // rotations [J * 9] row-major and local, translation [3] m
  async run(rotations, translation) {
    const given = { rotations: this.tensor("rotations", rotations), translation: this.tensor("translation", translation) };
    if (this.about.shapes.external) given.external = this.tensor("external", this.external);
    return this.session.run({ ...this.state, ...given });
  }

  // The names of the state: what comes back as next_NAME.
  names() {
    return Object.keys(this.about.shapes).filter((name) => `next_${name}` in this.about.shapes);
  }

  // The character has been standing in this pose: about.first_state.
  async stand(rotations, translation) {
    const size = (name) => this.about.shapes[name].reduce((a, b) => a * b, 1);
    const zeros = (name) => this.tensor(name, new Float32Array(size(name)));
    const first = Object.fromEntries(this.names().map((name) => [name, zeros(name)]));
    first.latent = this.tensor("latent", this.about.first_latent);
    this.state = first;
    const pushed = this.external;
    this.external = [0, 0, 0];
    const once = await this.run(rotations, translation);
    const newest = once.next_history.data.slice(0, size("history") / 2);
    this.state = { ...first, history: this.tensor("history", [...newest, ...newest]) };
    for (const name of ["garment", "position"]) if (name in first) this.state[name] = once[`next_${name}`];
    for (let i = 0; i < (this.about.settling ?? 0); i++) await this.step(rotations, translation);
    this.external = pushed;
  }

  // Vertices [V * 3] m of the next frame.
  async step(rotations, translation) {
    const result = await this.run(rotations, translation);
    this.state = Object.fromEntries(this.names().map((name) => [name, result[`next_${name}`]]));
    return result.vertices.data;
  }
}
