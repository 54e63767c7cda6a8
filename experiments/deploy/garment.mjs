// A character's garment in ONNX Runtime Web: one call a frame. `about` is the JSON that clothjax convert wrote.

export class Garment {
  constructor(ort, session, about) {
    Object.assign(this, { ort, session, about });
  }

  tensor(name, values) {
    return new this.ort.Tensor("float32", Float32Array.from(values), this.about.shapes[name]);
  }

  // rotations [J * 9] row-major and local, translation [3] m
  async run(rotations, translation) {
    const pose = { rotations: this.tensor("rotations", rotations), translation: this.tensor("translation", translation) };
    return this.session.run({ ...this.state, ...pose });
  }

  // The character has been standing in this pose: about.first_state.
  async stand(rotations, translation) {
    const first = this.tensor("latent", this.about.first_latent);
    const size = this.about.shapes.history.reduce((a, b) => a * b, 1);
    this.state = { latent: first, history: this.tensor("history", new Float32Array(size)) };
    const { next_history } = await this.run(rotations, translation);
    const newest = next_history.data.slice(0, size / 2);
    this.state = { latent: first, history: this.tensor("history", [...newest, ...newest]) };
  }

  // Vertices [V * 3] m of the next frame.
  async step(rotations, translation) {
    const result = await this.run(rotations, translation);
    this.state = { latent: result.next_latent, history: result.next_history };
    return result.vertices.data;
  }
}
