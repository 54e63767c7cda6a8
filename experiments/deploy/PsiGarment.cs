// A garment's ONNX file in Unity, one call a frame. It needs the packages Microsoft.ML.OnnxRuntime and
// com.unity.nuget.newtonsoft-json, and a character whose joints are those of the JSON, at rest as in the .glb:
//
//     python -m clothjax convert skirt --to onnx --out skirt.onnx
//     python -m clothjax render skirt --out skirt.glb --skinned
//
// Name skirt.onnx skirt.bytes, so that Unity takes it as it is. Hide the garment of the .glb, and add this script to
// the object that the root joint hangs on: there the garment's mesh is drawn. Unity's x is minus that of glTF.

using System.Collections.Generic;
using System.Linq;
using Microsoft.ML.OnnxRuntime;
using Microsoft.ML.OnnxRuntime.Tensors;
using Newtonsoft.Json.Linq;
using UnityEngine;

[RequireComponent(typeof(MeshFilter), typeof(MeshRenderer))]
public class PsiGarment : MonoBehaviour
{
    public TextAsset model, about; // skirt.bytes and skirt.json
    public Transform root; // such as Hips
    public Vector3 external; // m/s^2 beside gravity, such as wind: only of a garment with forces

    InferenceSession session;
    Dictionary<string, int[]> shapes;
    Dictionary<string, float[]> state;
    Transform[] joints;
    Vector3 rest;
    Mesh mesh;
    float frame, elapsed;

    void Start()
    {
        var given = JObject.Parse(about.text);
        session = new InferenceSession(model.bytes);
        shapes = given["shapes"].ToObject<Dictionary<string, int[]>>();
        frame = 1f / (float)given["fps"];
        var found = root.GetComponentsInChildren<Transform>();
        joints = given["joints"].Select(name => found.First(each => each.name == (string)name)).ToArray();
        rest = root.localPosition;
        Stand(given);
        mesh = new Mesh { vertices = Step() };
        mesh.triangles = given["faces"].SelectMany(face => face.Reverse().Select(corner => (int)corner)).ToArray();
        GetComponent<MeshFilter>().mesh = mesh;
    }

    void LateUpdate() // after the animation
    {
        elapsed += Time.deltaTime;
        if (elapsed < frame) return;
        elapsed %= frame;
        mesh.vertices = Step();
        mesh.RecalculateNormals();
        mesh.RecalculateBounds();
    }

    void OnDestroy()
    {
        session?.Dispose();
    }

    // The character has been standing in this pose: first_state of the JSON.
    void Stand(JObject given)
    {
        var names = shapes.Keys.Where(name => shapes.ContainsKey("next_" + name));
        state = names.ToDictionary(name => name, name => new float[shapes[name].Aggregate(1, (a, b) => a * b)]);
        state["latent"] = given["first_latent"].ToObject<float[]>();
        var once = Run(Vector3.zero);
        var newest = once["next_history"].Take(state["history"].Length / 2);
        state["history"] = newest.Concat(newest).ToArray();
        foreach (var name in new[] { "garment", "position" })
            if (state.ContainsKey(name)) state[name] = once["next_" + name];
        for (int i = 0; i < ((int?)given["settling"] ?? 0); i++) Feed(Run(Vector3.zero));
    }

    // The vertices of the next frame.
    Vector3[] Step()
    {
        var results = Run(external);
        Feed(results);
        var v = results["vertices"];
        var rows = Enumerable.Range(0, v.Length / 3);
        return rows.Select(i => new Vector3(-v[3 * i], v[3 * i + 1], v[3 * i + 2])).ToArray();
    }

    void Feed(Dictionary<string, float[]> results)
    {
        foreach (var name in state.Keys.ToArray()) state[name] = results["next_" + name];
    }

    Dictionary<string, float[]> Run(Vector3 pushed)
    {
        var given = new Dictionary<string, float[]>(state);
        given["rotations"] = joints.SelectMany(Rotation).ToArray();
        var moved = root.localPosition - rest;
        given["translation"] = new[] { -moved.x, moved.y, moved.z };
        if (shapes.ContainsKey("external")) given["external"] = new[] { -pushed.x, pushed.y, pushed.z };
        var inputs = given.Select(each =>
            NamedOnnxValue.CreateFromTensor(each.Key, new DenseTensor<float>(each.Value, shapes[each.Key]))).ToList();
        using (var results = session.Run(inputs))
            return results.Where(each => each.Name != "ok")
                .ToDictionary(each => each.Name, each => each.AsEnumerable<float>().ToArray());
    }

    static IEnumerable<float> Rotation(Transform joint)
    {
        var matrix = Matrix4x4.Rotate(joint.localRotation);
        for (int row = 0; row < 3; row++)
            for (int column = 0; column < 3; column++)
                yield return (row == 0) == (column == 0) ? matrix[row, column] : -matrix[row, column];
    }
}
